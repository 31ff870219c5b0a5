"""Variances of all pixels of a map, from the covariance of its harmonic coefficients.

diag(Y C Y^T) ring by ring: on a ring of HEALPix pixels y_lm = lambda_l|m|(theta) f_m(phi), so that
C shrinks to a matrix over m, m' of each ring before any pixel is looked at. N_modes^2 operations a
ring, where products with Y take N_modes^2 a pixel.
"""

from __future__ import annotations

import equinox as eqx
import healpy
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from lusee_bayes.harmonics import azimuth_functions, lmax_of, mode_numbers, polar_functions

# rings that are worked on at once
CHUNK = 16


def pixel_std(covariance: Float[Array, "modes modes"], nside: int) -> Float[np.ndarray, " pixels"]:
    """Standard deviation of every HEALPix RING pixel's centre, in the covariance's unit squared."""
    lmax = lmax_of(covariance.shape[0])
    theta, phi = healpy.pix2ang(nside, np.arange(healpy.nside2npix(nside)))
    heights, first, count = np.unique(theta, return_index=True, return_counts=True)
    # rings are padded to the longest one, and so is their number
    n_rings = -(-len(heights) // CHUNK) * CHUNK
    place = np.minimum(np.arange(count.max())[None], count[:, None] - 1) + first[:, None]
    place = np.pad(place, ((0, n_rings - len(heights)), (0, 0)), mode="edge")
    polar = np.pad(
        polar_functions(heights, lmax), ((0, n_rings - len(heights)), (0, 0)), mode="edge"
    )
    azimuth = azimuth_functions(phi, lmax)[place]
    variance = _variance(covariance, jnp.asarray(polar), jnp.asarray(azimuth))
    found = np.empty(len(theta))
    found[place] = np.asarray(variance)
    return np.sqrt(found)


@eqx.filter_jit
def _variance(
    covariance: Float[Array, "modes modes"],
    polar: Float[Array, "rings modes"],
    azimuth: Float[Array, "rings pixels orders"],
) -> Float[Array, "rings pixels"]:
    lmax = lmax_of(covariance.shape[0])
    ell, m = mode_numbers(lmax)
    table = np.full((2 * lmax + 1, lmax + 1), len(m))  # behind the last mode: zero
    table[m + lmax, ell] = np.arange(len(m))
    padded = jnp.pad(covariance, ((0, 1), (0, 1)))[table][..., table]
    heights = jnp.pad(polar, ((0, 0), (0, 1)))[:, table]

    def some(rings):
        y, f = rings
        left = jnp.einsum("rml,mlnk->rmnk", y, padded)
        both = jnp.einsum("rmnk,rnk->rmn", left, y)
        return jnp.einsum("rpm,rmn,rpn->rp", f, both, f)

    shape = (-1, CHUNK)
    chunked = (
        heights.reshape(*shape, *heights.shape[1:]),
        azimuth.reshape(*shape, *azimuth.shape[1:]),
    )
    return jax.lax.map(some, chunked).reshape(azimuth.shape[:2])
