"""How often error bars hold the truth, and how often they would by chance.

If a posterior is right, the truth is one of its draws. The pulls (truth - mean) / std are then
those of draws, z ~ N(0, corr(C)): each is standard normal, but neighbouring pixels pull alike, so
that counts over a band of latitude scatter far more than counts of independent pixels would. How
much they scatter is therefore counted, too, over the pulls of a few hundred draws.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from lusee_bayes.core.arrays import Draws, Modes, Pixels
from lusee_bayes.core.harmonics import mode_numbers, modes_to_map
from lusee_bayes.core.lazy import healpy, special

# of the central intervals that are counted, and their names in files
LEVELS = (0.50, 0.68, 0.90, 0.95)
NAMES = tuple(f"{100 * level:.0f}" for level in LEVELS)
REST = ("rms", "rms_scatter", "largest", "allowed")
# draws that tell the scatter: it is then known to 4 %
N_DRAWS = 300
# degrees of |b|: the plane, where the sky is furthest from the prior, its surroundings, the rest
LATITUDES = (10.0, 30.0)
# first ell of each group
ELLS = (0, 1, 5, 10, 20, 30, 50, 100, 200)
# share of draws whose largest pull is below the one that is called allowed
ALLOWED = 0.95


@dataclass(frozen=True)
class Coverage:
    """The pulls of a part of the sky, or of some multipoles.

    Attributes
    ----------
    name : str
    n : int
        Number of pixels or modes.
    held : tuple of float
        Share of them whose truth lies within the central interval of each of ``LEVELS``.
    scatter : tuple of float
        Standard deviation of ``held`` if the posterior is right.
    rms, rms_scatter : float
        Root mean square of the pulls, 1 on average if the posterior is right, and its scatter.
    largest : float
        The largest absolute pull.
    allowed : float
        What the largest one of 95 % of draws does not exceed.
    """

    name: str
    n: int
    held: tuple[float, ...]
    scatter: tuple[float, ...]
    rms: float
    rms_scatter: float
    largest: float
    allowed: float

    def row(self) -> dict[str, float | str]:
        """All of it by name, for JSON and CSV."""
        return {
            "name": self.name,
            "n": self.n,
            **{f"held_{name}": x for name, x in zip(NAMES, self.held, strict=True)},
            **{f"scatter_{name}": x for name, x in zip(NAMES, self.scatter, strict=True)},
            **{name: getattr(self, name) for name in REST},
        }


def coverage_of_pixels(std: Pixels, error: Modes, deviations: Draws) -> tuple[Coverage, ...]:
    """Count how many pixels are held by their error bars, by Galactic latitude.

    Parameters
    ----------
    std : (pixels,) array
        HEALPix RING, Galactic, in K.
    error : (modes,) array
        Truth less mean, in K.
    deviations : (draws, modes) array
        Draws of the posterior less its mean, in K, which tell the scatter.
    """
    nside = healpy.npix2nside(len(std))
    bands = latitudes(nside)
    pulls = (modes_to_map(x, nside) / std for x in (error, *deviations))
    counted = np.stack([_statistics(one, bands.values()) for one in pulls], axis=2)
    truth, draws = counted[..., 0], counted[..., 1:]
    n, allowed = len(LEVELS), np.quantile(draws[:, -1], ALLOWED, axis=1)
    columns = (x.tolist() for x in (truth, draws.std(2), truth[:, n + 1], allowed))
    sizes = (int(inside.sum()) for inside in bands.values())
    return tuple(
        Coverage(name, size, tuple(held[:n]), tuple(spread[:n]), held[n], spread[n], *largest)
        for name, size, held, spread, *largest in zip(bands, sizes, *columns, strict=True)
    )


def _statistics(
    pulls: Pixels, parts: Iterable[Bool[np.ndarray, " pixels"]]
) -> Float[np.ndarray, "parts statistics"]:
    """Shares within the intervals of ``LEVELS``, rms and largest absolute pull of each part."""
    limits = special.ndtri(0.5 + 0.5 * np.array(LEVELS))
    found = []
    for inside in parts:
        size = np.abs(pulls[inside])
        held = [(size < limit).mean() for limit in limits]
        found.append([*held, np.sqrt((size**2).mean()), size.max()])
    return np.array(found)


def latitudes(nside: int) -> dict[str, Bool[np.ndarray, " pixels"]]:
    """Which pixels (RING) are in the plane, beside it, far from it, and in the whole sky."""
    _, b = healpy.pix2ang(nside, np.arange(healpy.nside2npix(nside)), lonlat=True)
    near, far = LATITUDES
    return {
        f"|b| < {near:g} deg": np.abs(b) < near,
        f"|b| {near:g} to {far:g} deg": (np.abs(b) >= near) & (np.abs(b) <= far),
        f"|b| > {far:g} deg": np.abs(b) > far,
        "whole sky": np.ones(len(b), dtype=np.bool_),
    }


def multipoles(lmax: int) -> dict[str, Bool[np.ndarray, " modes"]]:
    """Which modes are of which group of multipoles."""
    ell, _ = mode_numbers(lmax)
    first = [edge for edge in ELLS if edge <= lmax]
    last = [*(edge - 1 for edge in first[1:]), lmax]
    return {
        f"ell {low} to {high}" if high > low else f"ell {low}": (ell >= low) & (ell <= high)
        for low, high in zip(first, last, strict=True)
    }
