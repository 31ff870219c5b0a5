"""Maps of draws of the sky: standard deviations, intervals, which region is brighter.

Skies are draws (chains, draws, modes) of Galactic harmonic coefficients in K, by HMC or
:meth:`Posterior.sample`; maps are HEALPix RING, Galactic, in K.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import arviz_base
import arviz_stats
import numpy as np
import pandas as pd
from arviz_stats.base import array_stats
from jaxtyping import Bool, Float

from lusee_bayes.core.checks import require_shape
from lusee_bayes.core.errors import InputError
from lusee_bayes.core.harmonics import lmax_of, pixel_matrix, power_spectrum, synthesis_matrix
from lusee_bayes.core.lazy import healpy

# pixels of which all draws are held at once
CHUNK = 1024

# columns of summaries: the same with ArviZ 0.8 and 1.x
INTERVAL = 0.9


def _per_pixel(
    skies: Float[np.ndarray, "chains draws modes"],
    nside: int,
    reduce: Callable[[Float[np.ndarray, "draws some"]], np.ndarray],
) -> np.ndarray:
    """``reduce`` of all draws of every pixel, chunk by chunk."""
    flat = skies.reshape(-1, skies.shape[-1])
    matrix = pixel_matrix(nside, lmax_of(flat.shape[-1]))
    parts = [reduce(flat @ matrix[i : i + CHUNK].T) for i in range(0, len(matrix), CHUNK)]
    return np.concatenate(parts, axis=-1)


def pixel_mean_of_draws(
    skies: Float[np.ndarray, "chains draws modes"], nside: int
) -> Float[np.ndarray, " pixels"]:
    """Compute the mean of every pixel over the draws, in K."""
    return _per_pixel(skies, nside, lambda values: values.mean(0))


def pixel_std_of_draws(
    skies: Float[np.ndarray, "chains draws modes"], nside: int
) -> Float[np.ndarray, " pixels"]:
    """Compute the standard deviation of every pixel over the draws, in K."""
    return _per_pixel(skies, nside, lambda values: values.std(0, ddof=1))


def pixel_interval_of_draws(
    skies: Float[np.ndarray, "chains draws modes"], nside: int, probability: float = INTERVAL
) -> Float[np.ndarray, "2 pixels"]:
    """Compute the lower and upper end of each pixel's central credible interval.

    Parameters
    ----------
    skies : (chains, draws, modes) array
        Draws, in K.
    nside : int
        NSIDE of the pixels.
    probability : float
        Of the interval, between 0 and 1.

    Returns
    -------
    (2, pixels) array
        In K.

    Raises
    ------
    InputError
        If the probability is not between 0 and 1.
    """
    if not 0 < probability < 1:
        raise InputError(f"the probability of an interval must lie in 0..1, got {probability}")
    tails = [(1 - probability) / 2, (1 + probability) / 2]
    return _per_pixel(skies, nside, lambda values: np.quantile(values, tails, axis=0))


def disc(nside: int, l_deg: float, b_deg: float, radius_deg: float) -> Bool[np.ndarray, " pixels"]:
    """Select the pixels within a radius of a Galactic direction.

    Parameters
    ----------
    nside : int
        NSIDE of the pixels.
    l_deg, b_deg : float
        Galactic longitude and latitude in degrees.
    radius_deg : float
        The radius in degrees.

    Raises
    ------
    InputError
        If no pixel lies within it.
    """
    inside = np.zeros(healpy.nside2npix(nside), dtype=bool)
    centre = healpy.ang2vec(l_deg, b_deg, lonlat=True)
    inside[healpy.query_disc(nside, centre, np.radians(radius_deg))] = True
    if not inside.any():
        raise InputError(
            f"no pixel of NSIDE {nside} lies within {radius_deg:g} degrees of l = {l_deg:g}, b = "
            f"{b_deg:g}; pixels are {healpy.nside2resol(nside, arcmin=True) / 60:.1f} degrees wide"
        )
    return inside


def region_brightness(
    skies: Float[np.ndarray, "chains draws modes"], region: Bool[np.ndarray, " pixels"]
) -> Float[np.ndarray, "chains draws"]:
    """Compute the mean brightness of a region for every draw, in K."""
    nside = healpy.npix2nside(len(region))
    row = pixel_matrix(nside, lmax_of(skies.shape[-1]))[region].mean(0)
    return skies @ row


def probability_brighter(
    skies: Float[np.ndarray, "chains draws modes"],
    first: Bool[np.ndarray, " pixels"],
    second: Bool[np.ndarray, " others"],
) -> tuple[float, float]:
    """Compute the probability that one region is brighter on average than another.

    Parameters
    ----------
    skies : (chains, draws, modes) array
        Draws, in K.
    first, second : (pixels,) array of bool
        The regions, of one NSIDE.

    Returns
    -------
    probability, error : float
        That the first is brighter, and its Monte Carlo error.

    Raises
    ------
    InputError
        For regions of different NSIDE.
    """
    require_shape("the second region", second, first.shape)
    brighter = region_brightness(skies, first) > region_brightness(skies, second)
    share = float(brighter.mean())
    if share in (0.0, 1.0):
        # no draw says otherwise: the rule of three bounds what n independent ones could miss
        return share, 3.0 / brighter.size
    error = array_stats.mcse(brighter.astype(float), chain_axis=0, draw_axis=1, method="mean")
    return share, float(error)


def sky_quantities(
    skies: Float[np.ndarray, "chains draws modes"],
    *,
    modes: Sequence[tuple[int, int]] = (),
    ells: Sequence[int] = (),
    pixels: Mapping[str, tuple[float, float]] | None = None,
) -> dict[str, Float[np.ndarray, "chains draws"]]:
    """Compute chosen quantities of every draw, by name.

    Parameters
    ----------
    skies : (chains, draws, modes) array
        Draws, in K.
    modes : sequence of (int, int)
        Modes (ell, m).
    ells : sequence of int
        Of powers C_ell.
    pixels : mapping of (float, float), optional
        Galactic longitude and latitude in degrees of brightnesses, by name.

    Raises
    ------
    InputError
        For modes and ells beyond lmax.
    """
    lmax = lmax_of(skies.shape[-1])
    columns = {}
    for name, (l_deg, b_deg) in (pixels or {}).items():
        theta, phi = np.radians([90.0 - b_deg]), np.radians([l_deg])
        columns[f"T({name}) [K]"] = skies @ synthesis_matrix(theta, phi, lmax)[0]
    spectra = power_spectrum(skies) if len(ells) else None
    for ell in ells:
        if not 0 <= ell <= lmax:
            raise InputError(f"there is no ell = {ell} up to lmax = {lmax}")
        columns[f"C_{ell} [K2]"] = spectra[..., ell]
    for ell, m in modes:
        if not (0 <= ell <= lmax and abs(m) <= ell):
            raise InputError(f"there is no mode (ell, m) = ({ell}, {m}) up to lmax = {lmax}")
        columns[f"sky({ell}, {m}) [K]"] = skies[..., ell**2 + ell + m]
    return columns


def summary(quantities: Mapping[str, Float[np.ndarray, "chains draws"]]) -> pd.DataFrame:
    """Make ArviZ's summary, a row for each quantity.

    It has mean, standard deviation, 90 % interval, bulk and tail ESS, R-hat and Monte Carlo
    errors.

    Parameters
    ----------
    quantities : mapping of (chains, draws) array
        Draws by name.
    """
    tree = arviz_base.from_dict({"posterior": dict(quantities)}, check_conventions=False)
    with np.errstate(all="ignore"):  # of chains that have not moved; NaN then says so
        return arviz_stats.summary(tree, ci_prob=INTERVAL, ci_kind="eti", round_to="none")
