"""Real spherical harmonics: packing, transforms and spectra.

A real field f = sum_c a_c y_c with the orthonormal real harmonics ::

    y_l0 = Y_l0,   y_lm = sqrt(2) Re Y_lm,   y_l,-m = -sqrt(2) Im Y_lm     (m > 0)

so that a_l0 = a_l0 (complex convention), a_lm = sqrt(2) Re a_lm, a_l,-m = sqrt(2) Im a_lm. Modes
are packed at index ell^2 + ell + m, m = -ell..ell; a smaller lmax is a slice. An isotropic field
has variance C_ell in every coefficient. Y_lm as in healpy (Condon-Shortley phase included).
"""

from __future__ import annotations

from functools import lru_cache
from itertools import pairwise

import numpy as np
from jaxtyping import Complex, Float

from lusee_bayes.core.arrays import Array
from lusee_bayes.core.checks import require_finite, require_whole
from lusee_bayes.core.errors import InputError
from lusee_bayes.core.lazy import healpy, special

SQRT2 = np.sqrt(2.0)
# beyond these, indices and memory of libraries in C give out
LARGEST_LMAX, LARGEST_NSIDE = 2047, 2048


def require_nside(nside: object) -> None:
    """InputError if it is no NSIDE of a HEALPix map."""
    require_whole("nside", nside, 1, LARGEST_NSIDE)
    if not healpy.isnsideok(nside, nest=True):
        raise InputError(f"nside is {nside}, expected a power of two; use 64, for example")


def n_modes(lmax: int) -> int:
    """Return the number of real coefficients up to ``lmax``: (lmax + 1)^2."""
    return (lmax + 1) ** 2


def lmax_of(n: int) -> int:
    """Return the lmax that has ``n`` modes.

    Raises
    ------
    InputError
        If ``n`` is not a square number.
    """
    lmax = round(np.sqrt(n)) - 1
    if n < 1 or n_modes(lmax) != n:
        raise InputError(f"{n} coefficients do not fill any lmax: expected a square number")
    return lmax


@lru_cache(maxsize=16)
def mode_numbers(lmax: int) -> tuple[np.ndarray, np.ndarray]:
    """Return ``ell`` and ``m`` of every packed mode, two integer arrays of shape (modes,)."""
    require_whole("lmax", lmax, 0, LARGEST_LMAX)
    ell = np.repeat(np.arange(lmax + 1), 2 * np.arange(lmax + 1) + 1)
    m = np.arange(n_modes(lmax)) - ell * (ell + 1)
    return ell, m


def from_healpy(
    alm: Complex[np.ndarray, "*batch alms"],
) -> Float[np.ndarray, "*batch modes"]:
    """Convert complex coefficients in healpy's packing (m >= 0, m-major) to real packed ones."""
    lmax = healpy.Alm.getlmax(alm.shape[-1])
    ell, m = mode_numbers(lmax)
    picked = alm[..., healpy.Alm.getidx(lmax, ell, np.abs(m))]
    return np.where(m == 0, picked.real, SQRT2 * np.where(m > 0, picked.real, picked.imag))


def to_healpy(modes: Float[Array, " modes"]) -> Complex[np.ndarray, " alms"]:
    """Convert real packed coefficients to healpy's; inverse of :func:`from_healpy`."""
    modes = np.asarray(modes)
    lmax = lmax_of(modes.shape[-1])
    ell, m = healpy.Alm.getlm(lmax)
    centre = ell * (ell + 1)
    alm = (modes[centre + m] + 1j * modes[centre - m]) / SQRT2
    return np.where(m == 0, modes[centre] + 0j, alm)


def map_to_modes(pixels: Float[np.ndarray, " pixels"], lmax: int) -> Float[np.ndarray, " modes"]:
    """Analyse a HEALPix map, by healpy's iterated quadrature.

    Parameters
    ----------
    pixels : (pixels,) array
        In RING order.
    lmax : int

    Returns
    -------
    (modes,) array
        Real packed coefficients up to ``lmax``, in the unit of the map.

    Raises
    ------
    InputError
        If the map has no valid NSIDE, holds NaN, or is too coarse (lmax > 3 NSIDE - 1), or if lmax
        is negative or no whole number.
    """
    require_whole("lmax", lmax, 0, LARGEST_LMAX)
    pixels = np.asarray(pixels, dtype=np.float64)
    if not healpy.isnpixok(pixels.size):
        raise InputError(f"{pixels.size} pixels are not a HEALPix map: expected 12 NSIDE^2")
    require_finite("the map", pixels)
    nside = healpy.npix2nside(pixels.size)
    if lmax > 3 * nside - 1:
        raise InputError(
            f"lmax = {lmax} is too large for a map of NSIDE {nside}, which holds lmax <= "
            f"{3 * nside - 1}; lower lmax or give a finer map"
        )
    return from_healpy(healpy.map2alm(pixels, lmax=lmax, iter=10))


def modes_to_map(modes: Float[Array, " modes"], nside: int) -> Float[np.ndarray, " pixels"]:
    """Synthesise the HEALPix RING map of packed coefficients."""
    require_nside(nside)
    alm = to_healpy(modes)
    return healpy.alm2map(alm, nside, lmax=lmax_of(np.shape(modes)[-1]))


@lru_cache(maxsize=8)
def _polar_functions(theta: tuple[float, ...], lmax: int) -> np.ndarray:
    """Y_lm at azimuth zero for every packed mode, which depends on ``|m|`` alone."""
    ell, m = mode_numbers(lmax)
    table = special.sph_legendre_p_all(lmax, lmax, np.array(theta))[0]
    return np.ascontiguousarray(table[ell, np.abs(m)].T)


def polar_functions(
    theta: Float[np.ndarray, " theta"], lmax: int
) -> Float[np.ndarray, "theta modes"]:
    """Return lambda_lm(theta), the Y_lm at azimuth zero, for ``|m|`` of every packed mode."""
    return _polar_functions(tuple(np.asarray(theta, dtype=float).ravel()), lmax)


def azimuth_functions(phi: Float[np.ndarray, " phi"], lmax: int) -> Float[np.ndarray, "phi orders"]:
    """Return the azimuthal factor of y for m = -lmax..lmax: -sqrt(2) sin, 1, sqrt(2) cos."""
    m = np.arange(1, lmax + 1)
    angle = np.asarray(phi, dtype=float)[:, None] * m
    return np.concatenate(
        [-SQRT2 * np.sin(angle)[:, ::-1], np.ones((len(angle), 1)), SQRT2 * np.cos(angle)], axis=1
    )


def synthesis_matrix(
    theta: Float[np.ndarray, " points"], phi: Float[np.ndarray, " points"], lmax: int
) -> Float[np.ndarray, "points modes"]:
    """Return the real harmonics in given directions: f(theta_i, phi_i) = sum_c matrix[i, c] a_c.

    Each distinct theta is computed once, so that HEALPix rings are cheap.

    Parameters
    ----------
    theta, phi : (points,) array
        In radians; theta from the pole.
    lmax : int

    Returns
    -------
    (points, modes) array
    """
    rings, ring_of_point = np.unique(np.asarray(theta, dtype=float), return_inverse=True)
    _, m = mode_numbers(lmax)
    matrix = polar_functions(rings, lmax)[ring_of_point]
    matrix *= azimuth_functions(phi, lmax)[:, m + lmax]
    return matrix


def pixel_matrix(nside: int, lmax: int) -> Float[np.ndarray, "pixels modes"]:
    """Return :func:`synthesis_matrix` at the centres of HEALPix RING pixels."""
    require_nside(nside)
    theta, phi = healpy.pix2ang(nside, np.arange(healpy.nside2npix(nside)))
    return synthesis_matrix(theta, phi, lmax)


def columns_to_maps(
    modes: Float[np.ndarray, "modes maps"], nside: int
) -> Float[np.ndarray, "pixels maps"]:
    """Synthesise many HEALPix RING maps at once, a column each: products of matrices by ring."""
    require_nside(nside)
    lmax = lmax_of(modes.shape[0])
    theta, phi = healpy.pix2ang(nside, np.arange(healpy.nside2npix(nside)))
    heights, first = np.unique(theta, return_index=True)
    _, m = mode_numbers(lmax)
    by_order = np.argsort(m, kind="stable")
    starts = np.searchsorted(m[by_order], np.arange(-lmax, lmax + 2))
    polar, packed = polar_functions(heights, lmax)[:, by_order], modes[by_order]
    waves = np.empty((len(heights), 2 * lmax + 1, modes.shape[1]))
    for order, (begin, end) in enumerate(pairwise(starts)):
        np.matmul(polar[:, begin:end], packed[begin:end], out=waves[:, order])
    azimuth = azimuth_functions(phi, lmax)
    maps = np.empty((len(phi), modes.shape[1]))
    for wave, (begin, end) in zip(waves, pairwise([*first, len(phi)]), strict=True):
        np.matmul(azimuth[begin:end], wave, out=maps[begin:end])
    return maps


def sum_over_m(values: Float[Array, "*batch modes"]) -> Float[np.ndarray, "*batch ells"]:
    """Sum a quantity that is given per mode over the modes of each ell = 0..lmax."""
    lmax = lmax_of(values.shape[-1])
    return np.add.reduceat(np.asarray(values), np.arange(lmax + 1) ** 2, axis=-1)


def mean_over_m(values: Float[Array, "*batch modes"]) -> Float[np.ndarray, "*batch ells"]:
    """Average a quantity that is given per mode over the modes of each ell = 0..lmax."""
    return sum_over_m(values) / (2.0 * np.arange(lmax_of(values.shape[-1]) + 1) + 1.0)


def power_spectrum(modes: Float[Array, "*batch modes"]) -> Float[np.ndarray, "*batch ells"]:
    """Return C_ell = sum_m a_lm^2 / (2 ell + 1) for ell = 0..lmax; the mean is not subtracted."""
    return mean_over_m(np.asarray(modes) ** 2)


def per_mode(spectrum: Float[Array, "*batch ells"]) -> Float[Array, "*batch modes"]:
    """Repeat a quantity that is given per ell for every mode of that ell."""
    ell, _ = mode_numbers(spectrum.shape[-1] - 1)
    return spectrum[..., ell]
