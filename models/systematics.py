"""The sky and everything that the scenario samples (``treatment: sampled``).

The sky is integrated out, and drawn exactly for every draw of the other parameters. If these are
numerous (gain drifts, errors of fields), it is more efficient to sample the sky with them.
"""

import numpyro

import lusee_bayes as lb
from lusee_bayes.systematics.systematic import sky_is_sampled


def model(gaussian, systematics, data=None):
    """``gaussian``: the model without ``systematics``, which are applied one after another."""
    for systematic in systematics:
        gaussian = systematic.sampled(gaussian)
    if sky_is_sampled(systematics):
        sky = numpyro.sample("sky", lb.SkyPrior(gaussian.prior))
        seen = lb.CorrelatedNormal(gaussian.predict(sky), gaussian.noise)
        numpyro.sample("data", seen, obs=data)
        return None  # no sky is left to be drawn
    numpyro.sample("data", lb.Marginal(gaussian), obs=data)
    return gaussian
