"""The sky and its data: m ~ N(0, S), d ~ N(A m + offset, N), with any N.

Without ``data``, it gives prior predictive draws. The posterior is Gaussian and known analytically
(``lb.LinearGaussian.condition``). Sampling it checks that result, and this program is a starting
point for your own.
"""

import numpyro

import lusee_bayes as lb


def model(coupling, offset, prior, fixed_noise, data=None):
    """``offset``: the data expected without a sky. ``fixed_noise``: N, factorised once."""
    sky = numpyro.sample("sky", lb.SkyPrior(prior))
    numpyro.sample("data", lb.CorrelatedNormal(coupling @ sky + offset, fixed_noise), obs=data)
