"""The data alone, the sky integrated out: d ~ N(0, A S A^T + N), with free noise level.

The sky needs no sampling: given each sampled noise level its draws are exact. Returning the linear
Gaussian model is what asks for them.
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
