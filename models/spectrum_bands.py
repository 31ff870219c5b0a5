"""The power spectrum in free bands: C_ell times one factor for every band of ells."""

import jax.numpy as jnp
import numpy as np
import numpyro
from numpyro import distributions as dist

import lusee_bayes as lb

# the first ell of every band but the lowest; those above the highest ell are left out
EDGES = np.array([1, 3, 6, 12, 24])


def model(coupling, offset, prior, noise, data=None):
    """``prior``: the spectrum that factors of one stand for; ln of each is uncertain by 1."""
    n_ells = prior.spectrum.shape[0]
    edges = EDGES[n_ells > EDGES]
    band = np.searchsorted(edges, np.arange(n_ells), side="right")
    power = numpyro.sample("band_power", dist.LogNormal(jnp.zeros(len(edges) + 1), 1.0).to_event(1))
    spectrum = prior.spectrum * power[band]
    gaussian = lb.LinearGaussian(coupling, lb.HarmonicPrior(spectrum), noise, offset)
    numpyro.sample("data", lb.Marginal(gaussian), obs=data)
    return gaussian
