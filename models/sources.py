"""Point sources of unknown flux in addition to the map: d = A m + sum_s f_s t_s + n.

Each source of the scenario has one site (``flux_Cas_A``, in K sr). The sky, now without the
sources, is integrated out.
"""

import numpyro

import lusee_bayes as lb


def model(gaussian, sources, data=None):
    """``gaussian``: the model without the sources; needs sources.treatment=sampled."""
    gaussian = sources.sampled(gaussian)
    numpyro.sample("data", lb.Marginal(gaussian), obs=data)
    return gaussian
