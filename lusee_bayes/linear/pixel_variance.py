"""Variances of all pixels of a map, from the covariance of its harmonic coefficients.

diag(Y C Y^T) ring by ring: on a ring of HEALPix pixels y_lm = lambda_l|m|(theta) f_m(phi), so that
C shrinks to a matrix over m, m' of each ring before any pixel is looked at. N_modes^2 operations a
ring, where products with Y take N_modes^2 a pixel; a ring and its mirror image in the south, where
lambda has the sign (-1)^(l + m), share half of them.
"""

from __future__ import annotations

import equinox as eqx
import healpy
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from lusee_bayes.core.arrays import Array
from lusee_bayes.core.harmonics import azimuth_functions, lmax_of, mode_numbers, polar_functions


def pixel_std(covariance: Float[Array, "modes modes"], nside: int) -> Float[np.ndarray, " pixels"]:
    """Compute the standard deviation of a map at the centre of every pixel.

    Parameters
    ----------
    covariance : (modes, modes) array
        Of the real harmonic coefficients, in K^2.
    nside : int
        HEALPix resolution.

    Returns
    -------
    (pixels,) array
        In K, in RING order.
    """
    lmax = lmax_of(covariance.shape[0])
    theta, phi = healpy.pix2ang(nside, np.arange(healpy.nside2npix(nside)))
    heights, first, count = np.unique(theta, return_index=True, return_counts=True)
    # rings are padded to the longest one; those from the equator on are in the south
    place = np.minimum(np.arange(count.max())[None], count[:, None] - 1) + first[:, None]
    north = polar_functions(heights[: len(heights) // 2 + 1], lmax)
    azimuth = azimuth_functions(phi, lmax)[place]
    variance = _variance(covariance, jnp.asarray(north), jnp.asarray(azimuth))
    found = np.empty(len(theta))
    found[place] = np.asarray(variance)
    return np.sqrt(found)


@eqx.filter_jit
def _variance(
    covariance: Float[Array, "modes modes"],
    polar: Float[Array, "north modes"],
    azimuth: Float[Array, "rings pixels orders"],
) -> Float[Array, "rings pixels"]:
    """Variances ring by ring. ``polar``: of the northern rings, the equator last."""
    lmax = lmax_of(covariance.shape[0])
    ell, m = mode_numbers(lmax)
    sign = jnp.asarray((-1.0) ** (ell + m))
    order_of = jnp.asarray(m[:, None] == np.arange(-lmax, lmax + 1)[None], dtype=jnp.float64)
    # the modes of every order, and the weight zero where there are none
    rows = np.zeros((2 * lmax + 1, lmax + 1), dtype=int)
    inside = np.zeros(rows.shape)
    rows[m + lmax, ell], inside[m + lmax, ell] = np.arange(len(m)), 1.0

    def of_order(order):
        row, there = order
        y = polar[:, row] * there[None]
        part = covariance[row]
        mirrored = (y * sign[row][None]) @ part
        north = ((y @ part) * polar) @ order_of
        return north, (mirrored * (polar * sign[None])) @ order_of

    north, south = jax.lax.map(of_order, (jnp.asarray(rows), jnp.asarray(inside)))
    # (orders, rings, orders); the equator is its own mirror image
    both = jnp.concatenate([north, south[:, -2::-1]], axis=1)
    return jnp.einsum("rpm,mrn,rpn->rp", azimuth, both, azimuth)
