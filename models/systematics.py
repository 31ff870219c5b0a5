"""Whatever the scenario says is to be sampled, and the sky: ``treatment: sampled``.

The sky is integrated out, and drawn exactly for every draw of the others, unless these are so many
(gain drifts, errors of fields) that they are better sampled together with the sky.
"""

import numpyro

import lusee_bayes as lb


def model(gaussian, systematics, data=None):
    """``gaussian``: the model without ``systematics``, which are applied one after the other."""
    for systematic in systematics:
        gaussian = systematic.sampled(gaussian)
    if lb.sky_is_sampled(systematics):
        sky = numpyro.sample("sky", lb.SkyPrior(gaussian.prior))
        seen = lb.CorrelatedNormal(gaussian.predict(sky), gaussian.noise)
        numpyro.sample("data", seen, obs=data)
        return None  # no sky is left to be drawn
    numpyro.sample("data", lb.Marginal(gaussian), obs=data)
    return gaussian
