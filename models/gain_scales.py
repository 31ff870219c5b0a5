"""Amplitude and speed of gain drifts: sigma_g and sigma_t, with sky and drifts integrated out.

The drifts enter N to second order, around given visibilities (noise.gain.visibilities).
"""

import jax.numpy as jnp
import numpyro
from numpyro import distributions as dist

import lusee_bayes as lb


def model(gaussian, gain_drifts, data=None):
    """The scenario gives the medians of the priors; ln of both has standard deviation 0.5."""
    at = gain_drifts.drift
    sigma = numpyro.sample("gain_sigma", dist.LogNormal(jnp.log(at.sigma), 0.5))
    # bounded, since the covariance's band must be as wide as the longest correlation time
    octaves = numpyro.sample("gain_octaves", dist.TruncatedNormal(0.0, 0.7, low=-1.0, high=1.0))
    hours = numpyro.deterministic("gain_correlation_h", at.correlation_h * 2.0**octaves)
    gaussian = gain_drifts.marginalised(gaussian, lb.GainDrift(sigma, hours))
    numpyro.sample("data", lb.Marginal(gaussian), obs=data)
    return gaussian
