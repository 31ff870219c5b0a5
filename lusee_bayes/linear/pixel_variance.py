"""Variances of all pixels of a map, from the covariance of its harmonic coefficients.

diag(Y C Y^T) ring by ring; see :mod:`lusee_bayes.core.harmonics`.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from jaxtyping import Float

from lusee_bayes.core.arrays import Array
from lusee_bayes.core.harmonics import (
    azimuth_functions,
    lmax_of,
    modes_by_order,
    order_products,
    polar_functions,
)
from lusee_bayes.core.lazy import healpy
from lusee_bayes.sky.priors import Prior


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
    covariance = np.asarray(covariance)
    heights, place, azimuth = _rings(nside, lmax_of(covariance.shape[0]))
    between = order_products(covariance, heights)
    return np.sqrt(_on_pixels(((azimuth @ between) * azimuth).sum(2), place))


def independent_pixel_std(
    variance: Float[Array, " modes"], nside: int
) -> Float[np.ndarray, " pixels"]:
    """Compute :func:`pixel_std` of coefficients that are independent of each other.

    Parameters
    ----------
    variance : (modes,) array
        Of the real harmonic coefficients, in K^2.
    nside : int
        HEALPix resolution.

    Returns
    -------
    (pixels,) array
        In K, in RING order.
    """
    variance = np.asarray(variance)
    lmax = lmax_of(len(variance))
    heights, place, azimuth = _rings(nside, lmax)
    by_order, first = modes_by_order(lmax)
    weighted = polar_functions(heights, lmax) ** 2 * variance
    of_orders = np.add.reduceat(weighted[:, by_order], first, axis=1)
    return np.sqrt(_on_pixels((azimuth**2 @ of_orders[:, :, None])[:, :, 0], place))


def prior_pixel_std(
    prior: Prior, nside: int, *, monopole: bool = True
) -> Float[np.ndarray, " pixels"]:
    """Compute :func:`pixel_std` of a prior.

    Parameters
    ----------
    prior : Prior
        Over harmonic coefficients.
    nside : int
        HEALPix resolution.
    monopole : bool
        Whether the monopole varies, too; else it is taken for known.

    Returns
    -------
    (pixels,) array
        In K, in RING order.
    """
    first = slice(0, 0 if monopole else 1)
    if prior.independent:
        variance = np.array(prior.variance())
        variance[first] = 0.0
        return independent_pixel_std(variance, nside)
    covariance = np.array(prior.covariance())
    covariance[first] = 0.0
    covariance[:, first] = 0.0
    return pixel_std(covariance, nside)


@lru_cache(maxsize=2)
def _rings(nside: int, lmax: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Heights of the rings, and the pixels of each with their azimuthal functions.

    Rings are padded to the longest one, by their last pixel.
    """
    theta, phi = healpy.pix2ang(nside, np.arange(healpy.nside2npix(nside)))
    heights, first, count = np.unique(theta, return_index=True, return_counts=True)
    place = np.minimum(np.arange(count.max())[None], count[:, None] - 1) + first[:, None]
    return heights, place, azimuth_functions(phi, lmax)[place]


def _on_pixels(
    values: Float[np.ndarray, "rings longest"], place: np.ndarray
) -> Float[np.ndarray, " pixels"]:
    found = np.empty(place.max() + 1)
    found[place] = values
    return found
