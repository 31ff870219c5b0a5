"""Points that do not lie on a smooth curve, found one after the other.

The worst points are left out, the curve is fitted again, and so on until none is further out than
noise allows; points that then lie on the curve come back. A point stands out if any of the autos
does.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

from lusee_bayes.core.lazy import special

# of the points beyond the threshold, those within this share of the worst go in one round
WORST = 0.5
MAX_ROUNDS = 60
# standard deviation of a Gaussian over the median of its absolute values
MAD = 1.4826


def threshold(false_alarm: float, n_tests: int) -> float:
    """Return how many standard deviations out a point may be.

    Parameters
    ----------
    false_alarm : float
        Chance that a point of pure noise is further out in any of its tests.
    n_tests : int
        Tests that a point has to pass, on both sides.
    """
    return float(-special.ndtri(false_alarm / (2.0 * n_tests)))


def outliers(
    values: Float[np.ndarray, "rows autos points"],
    noise: Float[np.ndarray, "rows autos points"],
    good: Bool[np.ndarray, "rows points"],
    basis: Float[np.ndarray, "points terms"],
    limit: float,
) -> tuple[Bool[np.ndarray, "rows points"], Float[np.ndarray, "rows autos points"]]:
    """Find points off a curve, in every row on its own.

    Parameters
    ----------
    values : (rows, autos, points) array
    noise : (rows, autos, points) array
        Standard deviations.
    good : (rows, points) array of bool
        Points to be looked at.
    basis : (points, terms) array
        What the curve is made of.
    limit : float
        :func:`threshold`.

    Returns
    -------
    (rows, points) array of bool
        Those that stand out.
    (rows, autos, points) array
        Distances from the curve through the others in standard deviations, 0 where not good.
    """
    kept, z = good.copy(), np.zeros_like(values)
    if not len(values):
        return good & ~kept, z
    active = np.arange(len(values))
    for _ in range(MAX_ROUNDS):
        z[active] = distances(values[active], noise[active], good[active], kept[active], basis)
        worst = np.abs(z[active]).max(axis=1)
        among = np.where(kept[active], worst, 0.0)
        most = among.max(axis=1, keepdims=True)
        out = (among > limit) & (among >= WORST * most)
        # a curve needs more points than it has terms
        enough = (kept[active] & ~out).sum(axis=1) > basis.shape[1]
        out &= enough[:, None]
        if not out.any():
            break
        kept[active] &= ~out
        active = active[out.any(axis=1)]
    back = good & ~kept & (np.abs(z).max(axis=1) <= limit)
    kept |= back
    return good & ~kept, z


def distances(
    values: Float[np.ndarray, "rows autos points"],
    noise: Float[np.ndarray, "rows autos points"],
    good: Bool[np.ndarray, "rows points"],
    kept: Bool[np.ndarray, "rows points"],
    basis: Float[np.ndarray, "points terms"],
) -> Float[np.ndarray, "rows autos points"]:
    """Return how far points are from the curve through some of them.

    Parameters
    ----------
    values, noise, good, basis
        As :func:`outliers`.
    kept : (rows, points) array of bool
        Those that the curve goes through.

    Returns
    -------
    (rows, autos, points) array
        In standard deviations, the curve's own uncertainty included; 0 where not good.
    """
    curve, leverage = curves(values, kept, basis)
    own = np.where(kept, 1.0 - leverage, 1.0 + leverage)
    scale = noise * np.sqrt(np.maximum(own, 1e-3))[:, None]
    return np.where(good[:, None], (values - curve) / scale, 0.0)


def curves(
    values: Float[np.ndarray, "rows autos points"],
    kept: Bool[np.ndarray, "rows points"],
    basis: Float[np.ndarray, "points terms"],
) -> tuple[Float[np.ndarray, "rows autos points"], Float[np.ndarray, "rows points"]]:
    """Return the curve through some points, and its variance in units of that of a point.

    Parameters
    ----------
    values, kept, basis
        As :func:`distances`.
    """
    terms = basis.shape[1]
    normal = np.einsum("rk,ka,kb->rab", kept.astype(float), basis, basis, optimize=True)
    normal[kept.sum(axis=1) <= terms] = np.eye(terms)
    inverse = np.linalg.inv(normal)
    pulled = np.einsum("rpk,ka->rpa", np.where(kept[:, None], values, 0.0), basis)
    curve = np.einsum("rab,rpb,ka->rpk", inverse, pulled, basis, optimize=True)
    leverage = np.einsum("rab,ka,kb->rk", inverse, basis, basis, optimize=True)
    return curve, leverage


def robust_scale(
    z: Float[np.ndarray, "rows points"], good: Bool[np.ndarray, "rows points"]
) -> float:
    """Return the standard deviation of distances by their median; NaN if there are none."""
    return float(MAD * np.median(np.abs(z[good]))) if good.any() else np.nan
