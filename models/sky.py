"""The sky and its data: m ~ N(0, S), d ~ N(A m, N), with any N.

``data`` None gives prior predictive draws. The posterior is Gaussian and known analytically
(``lb.LinearGaussian.condition``); sampling it is a check of that, and the place to begin a program
of your own.
"""

import numpyro

import lusee_bayes as lb


def model(coupling, prior, noise, data=None):
    """``noise``: a covariance, or its factor where it is fixed."""
    sky = numpyro.sample("sky", lb.SkyPrior(prior))
    return numpyro.sample("data", lb.CorrelatedNormal(coupling @ sky, noise), obs=data)
