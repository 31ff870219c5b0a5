"""Amplitude and tilt of the sky's power spectrum: C_ell -> A C_ell ((ell + 1) / 10)^tilt.

A (``amplitude``) and ``tilt`` are sampled with the sky integrated out. A sky is then drawn given
each sample, so that the sky's uncertainty includes theirs.
"""

import jax.numpy as jnp
import numpyro
from numpyro import distributions as dist

import lusee_bayes as lb


def model(coupling, offset, prior, noise, data=None):
    """``prior``: the spectrum for A = 1 and tilt = 0."""
    if not isinstance(prior, lb.HarmonicPrior):
        raise lb.InputError("prior_amplitude needs a spectrum: use --set prior.model=isotropic")
    amplitude = numpyro.sample("amplitude", dist.LogNormal(0.0, 0.5))
    tilt = numpyro.sample("tilt", dist.Normal(0.0, 0.5))
    ell = jnp.arange(float(prior.spectrum.shape[0]))
    spectrum = prior.spectrum * amplitude * ((ell + 1.0) / 10.0) ** tilt
    gaussian = lb.LinearGaussian(coupling, lb.HarmonicPrior(spectrum), noise, offset)
    numpyro.sample("data", lb.Marginal(gaussian), obs=data)
    return gaussian
