"""How often error bars cover the truth, and how often they would by chance.

If a posterior is correct, the truth is one of its draws. The pulls (truth - mean) / std are then
distributed like those of draws, z ~ N(0, corr(C)): each is standard normal, but neighbouring pixels
are correlated, so that counts over a band of latitude scatter far more than counts of independent
pixels. This scatter is therefore measured, too, from the pulls of a few hundred draws.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from lusee_bayes.core.arrays import Draws, Modes, Pixels
from lusee_bayes.core.harmonics import mode_numbers, modes_to_map
from lusee_bayes.core.lazy import healpy, special

# absolute or signed pulls of several skies
Pulls = Float[np.ndarray, "skies n"]
# probabilities of the central intervals
LEVELS = (0.50, 0.68, 0.90, 0.95)
# skies whose pulls are counted at once
AT_ONCE = 16
# draws that determine the scatter, to 4 %
N_DRAWS = 300
# degrees of |b|: the plane, where the sky is furthest from the prior, its surroundings, the rest
LATITUDES = (10.0, 30.0)
# first ell of each group
ELLS = (0, 1, 5, 10, 20, 30, 50, 100, 200)
# fraction of draws whose largest pull is below ``allowed``
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
        Fraction of them whose truth lies within the central interval of each of ``LEVELS``.
    scatter : tuple of float
        Standard deviation of these fractions if the posterior is correct.
    rms, rms_scatter : float
        Root mean square of the pulls, 1 on average if the posterior is correct, and its scatter.
    largest : float
        The largest absolute pull.
    allowed : float
        95 % of draws have a smaller largest pull than this.
    """

    name: str
    n: int
    held: tuple[float, ...]
    scatter: tuple[float, ...]
    rms: float
    rms_scatter: float
    largest: float
    allowed: float


@dataclass(frozen=True)
class Counts:
    """Statistics of the pulls of the truth and of draws, part by part.

    Attributes
    ----------
    names : tuple of str
        Of the parts.
    sizes : tuple of int
        Number of pixels or modes of each.
    values : (parts, statistics, skies) array
        Fractions within the intervals of ``LEVELS``, rms and largest absolute pull: of the truth
        first, then of every draw.
    """

    names: tuple[str, ...]
    sizes: tuple[int, ...]
    values: Float[np.ndarray, "parts statistics skies"]

    @classmethod
    def of_pixels(cls, std: Pixels, error: Modes, deviations: Draws) -> Counts:
        """Count pixels by Galactic latitude.

        Parameters
        ----------
        std : (pixels,) array
            HEALPix RING, Galactic, in K.
        error : (modes,) array
            Truth minus mean, in K.
        deviations : (draws, modes) array
            Draws of the posterior minus its mean, in K.
        """
        nside, skies = healpy.npix2nside(len(std)), np.stack([error, *deviations])
        blocks = np.array_split(skies, -(-len(skies) // AT_ONCE))
        return cls.of(latitudes(nside), (modes_to_map(some, nside) / std for some in blocks))

    @classmethod
    def of(cls, parts: Mapping[str, np.ndarray], pulls: Iterable[Pulls]) -> Counts:
        """Count the pulls of the truth and of draws, a few skies at a time, in each part."""
        inside = np.stack(list(parts.values()), axis=1)
        counted = np.concatenate([_statistics(np.abs(some), inside) for some in pulls], axis=2)
        return cls(tuple(parts), tuple(inside.sum(axis=0).tolist()), counted)

    def coverage(self) -> tuple[Coverage, ...]:
        """The coverage of each part, with its scatter."""
        truth, draws = self.values[..., 0], self.values[..., 1:]
        n, allowed = len(LEVELS), np.quantile(draws[:, -1], ALLOWED, axis=1)
        columns = (x.tolist() for x in (truth, draws.std(2), truth[:, n + 1], allowed))
        parts = zip(self.names, self.sizes, *columns, strict=True)
        return tuple(
            Coverage(name, size, tuple(held[:n]), tuple(spread[:n]), held[n], spread[n], *largest)
            for name, size, held, spread, *largest in parts
        )


def _statistics(
    size: Pulls, inside: Bool[np.ndarray, "n parts"]
) -> Float[np.ndarray, "parts statistics skies"]:
    weights = inside / inside.sum(axis=0)
    held = [(size < limit) @ weights for limit in special.ndtri(0.5 + 0.5 * np.array(LEVELS))]
    largest = [size.take(np.flatnonzero(part), axis=1).max(axis=1) for part in inside.T]
    return np.stack([*held, np.sqrt(size**2 @ weights), np.transpose(largest)]).transpose(2, 0, 1)


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
    """Which modes are in each group of multipoles."""
    ell, _ = mode_numbers(lmax)
    first = [edge for edge in ELLS if edge <= lmax]
    return {
        f"ell {low} to {high}" if high > low else f"ell {low}": (ell >= low) & (ell <= high)
        for low, high in zip(first, [*(edge - 1 for edge in first[1:]), lmax], strict=True)
    }
