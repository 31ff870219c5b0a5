"""The sky and its data: m ~ N(0, S), d ~ N(A m + offset, N), with any N.

``data`` None gives prior predictive draws. The posterior is Gaussian and known analytically
(``lb.LinearGaussian.condition``); sampling it is a check of that, and the place to begin a program
of your own.
"""

import numpyro

import lusee_bayes as lb


def model(coupling, offset, prior, fixed_noise, data=None):
    """``offset``: what is seen without a sky. ``fixed_noise``: N, factorised once."""
    sky = numpyro.sample("sky", lb.SkyPrior(prior))
    numpyro.sample("data", lb.CorrelatedNormal(coupling @ sky + offset, fixed_noise), obs=data)
