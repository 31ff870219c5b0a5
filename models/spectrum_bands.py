"""The power spectrum in free bands: C_ell times one factor per band of ells."""

import jax.numpy as jnp
import numpy as np
import numpyro
from numpyro import distributions as dist

import lusee_bayes as lb

# the first ell of every band except the lowest; bands above the highest ell are ignored
EDGES = np.array([1, 3, 6, 12, 24])


def model(coupling, offset, prior, noise, data=None):
    """``prior``: the spectrum when all factors are one; ln of each factor is uncertain by 1."""
    if not isinstance(prior, lb.HarmonicPrior):
        raise lb.InputError("spectrum_bands needs a spectrum: use --set prior.model=isotropic")
    n_ells = prior.spectrum.shape[0]
    edges = EDGES[n_ells > EDGES]
    band = np.searchsorted(edges, np.arange(n_ells), side="right")
    power = numpyro.sample("band_power", dist.LogNormal(jnp.zeros(len(edges) + 1), 1.0).to_event(1))
    spectrum = prior.spectrum * power[band]
    gaussian = lb.LinearGaussian(coupling, lb.HarmonicPrior(spectrum), noise, offset)
    numpyro.sample("data", lb.Marginal(gaussian), obs=data)
    return gaussian
