"""Coverage: how often error bars hold the known truth, by band of Galactic latitude.

Whether a pixel is within t standard deviations is an even function of its pull z. Its leading term
in Hermite polynomials is -t phi(t) (z^2 - 1). For a field of white modes up to lmax the mean of
z^2 - 1 over the sky has the variance 2 / (lmax + 1)^2.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from itertools import pairwise
from math import erf, exp, pi, sqrt

import numpy as np
from jaxtyping import Bool, Float

from lusee_bayes.core.lazy import healpy

# degrees of |b|: the plane, where the sky is furthest from the prior, its surroundings, the rest
EDGES = (0.0, 10.0, 30.0, 90.0)
# share of a normal distribution within one and two standard deviations
EXPECTED = (erf(1.0 / sqrt(2.0)), erf(2.0 / sqrt(2.0)))


@dataclass(frozen=True)
class Band:
    """The pixels between two latitudes, North and South.

    Attributes
    ----------
    name : str
    sky : float
        Share of the sky.
    within_1, within_2 : float
        Share of pixels whose truth is within one and two standard deviations of the mean.
    error_1, error_2 : float
        About how far these are from 68.3 % and 95.4 % by chance. With n harmonic modes times the
        share of the sky, sqrt(2/n) t phi(t) for t standard deviations and phi the normal density:
        the leading term for a field whose modes are independent and alike.
    rms : float
        Root mean square of (mean - truth) / standard deviation; 1 is expected.
    """

    name: str
    sky: float
    within_1: float
    within_2: float
    error_1: float
    error_2: float
    rms: float


def coverage(
    mean: Float[np.ndarray, " pixels"],
    std: Float[np.ndarray, " pixels"],
    truth: Float[np.ndarray, " pixels"],
    lmax: int,
) -> list[Band]:
    """Count where the truth is within the error bars.

    Parameters
    ----------
    mean, std, truth : (pixels,) array
        HEALPix RING, Galactic, K.
    lmax : int
        Of the maps.
    """
    pull = np.abs(mean - truth) / std
    _, b = healpy.pix2ang(healpy.npix2nside(mean.size), np.arange(mean.size), lonlat=True)
    found = [
        _band(f"|b| {low:g} to {high:g} deg", pull, (np.abs(b) >= low) & (np.abs(b) < high), lmax)
        for low, high in pairwise(EDGES)
    ]
    return [*found, _band("whole sky", pull, np.ones(mean.size, dtype=np.bool_), lmax)]


def coverage_rows(
    maps: Mapping[str, Float[np.ndarray, " pixels"]], lmax: int
) -> list[dict[str, object]] | None:
    """:func:`coverage` of maps by name, for summary.json; None where the truth is not known."""
    if "truth" not in maps:
        return None
    return [asdict(band) for band in coverage(maps["mean"], maps["std"], maps["truth"], lmax)]


def _band(
    name: str, pull: Float[np.ndarray, " pixels"], inside: Bool[np.ndarray, " pixels"], lmax: int
) -> Band:
    sky, mine = float(inside.mean()), pull[inside]
    independent = max(1.0, sky * (lmax + 1) ** 2)
    errors = [sqrt(2.0 / independent) * t * exp(-0.5 * t**2) / sqrt(2.0 * pi) for t in (1.0, 2.0)]
    within = [float((mine < limit).mean()) for limit in (1.0, 2.0)]
    return Band(name, sky, *within, *errors, float(np.sqrt((mine**2).mean())))
