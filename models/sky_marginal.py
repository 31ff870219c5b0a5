"""The data with the sky integrated out: d ~ N(offset, A S A^T + N), with free noise level.

The sky needs no sampling: it is drawn exactly given each sampled noise level. Returning the linear
Gaussian model requests these draws.
"""

import numpyro
from numpyro import distributions as dist

import lusee_bayes as lb


def model(coupling, offset, prior, noise, data=None):
    """``noise``: the covariance whose level is sampled as ``noise_level`` (variance ratio)."""
    level = numpyro.sample("noise_level", dist.LogNormal(0.0, 1.0))
    gaussian = lb.LinearGaussian(coupling, prior, noise.scaled(level), offset)
    numpyro.sample("data", lb.Marginal(gaussian), obs=data)
    return gaussian
