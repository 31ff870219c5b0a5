"""What A knows of time: the fewest functions that give every sample's mean over its window.

With W_p the tilted copies of a beam (``rotations.tilts``), a row of A at one instant is the sum
over p and the orders m of e_p(t) exp(i m phi(t)) W_p,m. Its mean over a window, where phi is
phi_mean + delta, has the factors ::

    < e_p exp(i m delta) > exp(i m phi_mean),    < e_p exp(i m delta) > = sum_k (i m)^k / k! mu_pk,

with mu_pk = < e_p delta^k > the moments. As functions of time they are almost all alike: a singular
value decomposition finds u_j(t) and G_j(p, m), few of each, with ::

    < e_p exp(i m delta) >(t) = sum_j u_j(t) G_j(p, m).

The beams take up G, and time enters A through u_j(t) and exp(i m phi_mean) alone. For windows of
one length the first function stands for the mean over a turn about a fixed axis, which is a factor
for each order m; others for the wandering of the axis, and for windows that are partly filled.
"""

from __future__ import annotations

from math import factorial, lgamma

import numpy as np
from jaxtyping import Float, Int
from threadpoolctl import threadpool_limits

from lusee_bayes.core.harmonics import tilt_powers

# of what is left out of any sample, relative to its visibility if what a beam sees of the sky falls
# with ell to this power: less than 1e-6 of the radiometer noise in the fiducial case
TOLERANCE, FALLING = 5e-11, -3.5
# of the quadrature over a piece, and of the series in moments
ROUNDING = 1e-14


def sufficient_nodes(angle: float) -> int:
    """Return how many Gauss-Legendre instants a piece needs.

    Parameters
    ----------
    angle : float
        ``lmax`` times half the angle, in radians, by which the Moon turns in the longest piece.

    Returns
    -------
    int
        The lowest number whose mean of cos(angle x) over -1 < x < 1 errs by less than 1e-14 (from
        the remainder of the quadrature).
    """
    n = 1
    while _quadrature_error(n, angle) > ROUNDING:
        n += 1
    return n


def _quadrature_error(n: int, angle: float) -> float:
    """Half of 2^(2n+1) n!^4 / ((2n+1) (2n)!^3) times the largest 2n-th derivative."""
    if angle == 0.0:
        return 0.0
    log = 2 * n * np.log(2.0 * angle) + 4 * lgamma(n + 1) - 3 * lgamma(2 * n + 1)
    return float(np.exp(log) / (2 * n + 1))


def windowed(
    sample: Int[np.ndarray, " nodes"],
    weight: Float[np.ndarray, " nodes"],
    azimuth: Float[np.ndarray, " nodes"],
    tilt: Float[np.ndarray, "nodes 2"],
    order: int,
    lmax: int,
) -> tuple[
    Float[np.ndarray, " times"],
    Float[np.ndarray, "times functions"],
    Float[np.ndarray, "functions powers orders 2"],
]:
    """Average what A knows of time over windows.

    Parameters
    ----------
    sample : (nodes,) array of int
        The sample of every instant, growing.
    weight : (nodes,) array
        One in total for each sample.
    azimuth : (nodes,) array
        phi, in radians.
    tilt : (nodes, 2) array
        (ex, ey), in radians.
    order : int
        Of the expansion in the tilt.
    lmax : int
        Highest order m of the beams.

    Returns
    -------
    azimuth : (times,) array
        phi_mean, in radians.
    functions : (times, functions) array
        u_j, the most important ones first.
    factors : (functions, powers, orders, 2) array
        Real and imaginary part of G_j(p, m), for the powers in the order of
        :func:`.tilt_powers` and m = 0 .. lmax.
    """
    first = np.searchsorted(sample, np.arange(sample[-1] + 1))
    delta = azimuth - azimuth[first][sample]
    delta = np.remainder(delta + np.pi, 2.0 * np.pi) - np.pi
    mean = np.add.reduceat(weight * delta, first)
    delta = delta - mean[sample]
    largest = float(np.abs(delta).max())
    n_moments = _sufficient_moments(lmax * largest)
    scaled = delta / (largest or 1.0)
    powers = tilt_powers(order)
    ex, ey = -tilt[:, 0], -tilt[:, 1]
    # the transpose of the exponential has the opposite sign
    e = np.stack([ex**a * ey**b / factorial(a + b) for a, b in powers], axis=1)
    moments = np.stack(
        [
            np.add.reduceat(weight[:, None] * e * scaled[:, None] ** k, first, axis=0)
            for k in range(n_moments)
        ],
        axis=2,
    ).reshape(len(first), -1)
    series = _series(powers, n_moments, largest, lmax)
    # small matrices: several threads would wait for one another
    with threadpool_limits(1, "blas"):
        functions, factors = _fewest(moments, series)
    weights = _importance(powers, lmax)
    factors = factors.reshape(len(factors), len(powers), lmax + 1, 2) / weights[..., None]
    return azimuth[first] + mean, functions, factors


def _sufficient_moments(angle: float) -> int:
    """How many terms of exp(i x) are needed up to |x| = angle."""
    n, term = 1, angle
    while term > ROUNDING:
        n += 1
        term *= angle / n
    return n


def _importance(powers: list[tuple[int, int]], lmax: int) -> Float[np.ndarray, "powers orders"]:
    """What each power of the tilt makes of the harmonics of one order."""
    ell = np.arange(1.0, max(lmax, 1) + 1.0)
    return np.array(
        [
            [(ell[ell >= max(m, 1)] ** (a + b + FALLING)).sum() for m in range(lmax + 1)]
            for a, b in powers
        ]
    )


def _series(
    powers: list[tuple[int, int]], n_moments: int, largest: float, lmax: int
) -> Float[np.ndarray, "moments columns"]:
    """(i m)^k / k! for scaled moments, real and imaginary parts, weighted by their importance."""
    m = np.arange(lmax + 1.0)
    terms = np.zeros((n_moments, lmax + 1), dtype=complex)
    for k in range(n_moments):
        terms[k] = (1j * m * largest) ** k / factorial(k)
    parts = np.stack([terms.real, terms.imag], axis=-1)
    weighted = _importance(powers, lmax)[:, None, :, None] * parts[None]
    n = len(powers)
    series = np.zeros((n, n_moments, n, lmax + 1, 2))
    series[np.arange(n), :, np.arange(n)] = weighted
    return series.reshape(n * n_moments, -1)


def _fewest(
    moments: Float[np.ndarray, "times moments"], series: Float[np.ndarray, "moments columns"]
) -> tuple[Float[np.ndarray, "times functions"], Float[np.ndarray, "functions columns"]]:
    """Functions u and factors G with u G = moments x series at every time, to ``TOLERANCE``."""
    q, r = np.linalg.qr(moments)
    across, left = np.linalg.qr(series.T)
    u, s, vt = np.linalg.svd(r @ left.T)
    n = min(u.shape[0], vt.shape[0])
    u, vt = u[:, :n], vt[:n] @ across.T
    contributions = (q @ u) * s
    size = np.sqrt((contributions**2).sum(1).max())
    # what is left of each sample without the last functions
    missing = np.sqrt(np.cumsum((contributions**2)[:, ::-1], axis=1)[:, ::-1].max(0))
    keep = max(1, int((missing > TOLERANCE * size).sum()))
    return contributions[:, :keep], vt[:keep]
