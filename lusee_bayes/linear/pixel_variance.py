"""Variances of all pixels of a map, from the covariance of its harmonic coefficients.

diag(Y C Y^T) ring by ring: on a ring of HEALPix pixels y_lm = lambda_l|m|(theta) f_m(phi), so that
C shrinks to a matrix over m <= m' of each ring before any pixel is looked at. N_modes^2 operations
a ring, where products with Y take N_modes^2 a pixel; a ring and its mirror image in the south,
where lambda has the sign (-1)^(l + m), share half of them.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from jaxtyping import Float

from lusee_bayes.core.arrays import Array
from lusee_bayes.core.harmonics import azimuth_functions, lmax_of, mode_numbers, polar_functions
from lusee_bayes.core.lazy import healpy


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
    lmax = lmax_of(covariance.shape[0])
    heights, place, azimuth = _rings(nside, lmax)
    # rings from the equator on are in the south
    polar = polar_functions(heights[: len(heights) // 2 + 1], lmax)
    by_order, first = _orders(lmax)
    ell, m = mode_numbers(lmax)
    polar, odd = polar[:, by_order], ((ell + m) % 2 == 1)[by_order]
    mirrored = np.where(odd, -polar, polar)
    both = np.zeros((2 * lmax + 1, len(heights), 2 * lmax + 1))
    for order, rows in enumerate(np.split(np.arange(len(m)), first[1:])):
        # the matrix is symmetric: those of m < m' count twice, those of m > m' are left out
        begin, starts = rows[0], first[order:] - rows[0]
        here = covariance[by_order[rows]].take(by_order[begin:], axis=1)
        here[:, len(rows) :] *= 2.0
        even_part, odd_part = (
            polar[:, rows[some]] @ here[some] for some in (~odd[rows], odd[rows])
        )
        # the equator is its own mirror image
        north, south = both[order, : len(polar)], both[order, ::-1][: len(polar)]
        total = even_part + odd_part
        total *= polar[:, begin:]
        north[:, order:] = np.add.reduceat(total, starts, axis=1)
        np.subtract(even_part, odd_part, out=total)
        total *= mirrored[:, begin:]
        south[:, order:] = np.add.reduceat(total, starts, axis=1)
    between = both.transpose(1, 0, 2)
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
    by_order, first = _orders(lmax)
    weighted = polar_functions(heights, lmax) ** 2 * variance
    of_orders = np.add.reduceat(weighted[:, by_order], first, axis=1)
    return np.sqrt(_on_pixels((azimuth**2 @ of_orders[:, :, None])[:, :, 0], place))


def _orders(lmax: int) -> tuple[np.ndarray, np.ndarray]:
    """The packed modes by growing m, and where each m begins."""
    _, m = mode_numbers(lmax)
    by_order = np.argsort(m, kind="stable")
    return by_order, np.searchsorted(m[by_order], np.arange(-lmax, lmax + 1))


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
