"""A positive sky and its data: m = P[T exp(Y a)] + sources, d ~ N(A m, N).

``structure`` contains the white unknowns of the sky. If the scenario does not give C_ell of the
sky's logarithm, ``amplitude`` and ``tilt`` are sampled, too.
"""

import numpyro

import lusee_bayes as lb


def model(gaussian, log_normal, fixed_noise, data=None):
    """``log_normal``: the prior; ``gaussian``: a model of which only A is used, not the prior."""
    sky = log_normal.sampled()
    numpyro.sample("data", lb.CorrelatedNormal(gaussian.predict(sky), fixed_noise), obs=data)
