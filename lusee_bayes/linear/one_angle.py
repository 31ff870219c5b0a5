"""A^T W A of the samples at one turntable angle, from beams and Fourier sums over time.

The equations are those of :mod:`.normal_matrix`; here is the arithmetic that takes the time.
"""

from __future__ import annotations

from functools import lru_cache
from itertools import pairwise

import numpy as np
from jaxtyping import Complex, Float, Int

from lusee_bayes.core.arrays import Array, compiled, namespace, placed, scan
from lusee_bayes.core.harmonics import mode_numbers
from lusee_bayes.linear.time_sums import time_sums

# strips of orders where they are compiled: more save products with zeros
N_STRIPS = 6


@compiled
def of_one_angle(
    by_order: Float[Array, "orders beams degrees"],
    weights: Float[Array, "..."],
    azimuth: Float[Array, " times"],
    functions: Float[Array, "functions times"],
    n_products: int,
) -> Float[Array, "modes modes"]:
    """The lower triangle of their part in the mean-pole frame; modes as :func:`places` has them."""
    n = by_order.shape[0]
    beams = by_order.reshape(n, n_products, -1, 2, n).swapaxes(2, 3)
    f = time_sums(weights.reshape(-1, azimuth.shape[0]), azimuth, functions.T, n - 1)
    return _from_sums(beams, f.reshape(*weights.shape[:-1], *f.shape[1:]))


def _from_sums(
    beams: Float[Array, "orders products 2 functions degrees"], f: Complex[Array, "..."]
) -> Float[Array, "modes modes"]:
    """The matrix of beams (W_lm, W_l,-m) and Fourier sums, one strip of orders after the other.

    Only columns of orders up to the strip's own last one, and rows of degrees from its first one,
    are computed; the others are mirror images, or zero. Modes come in the order of
    :func:`places`, so that a strip is one block on and below the diagonal.
    """
    xp, n = namespace(beams, f), beams.shape[0]
    # of every mode: degree, order, and whether it is a_l,-m
    ell, m = (x[_by_order(n - 1)] for x in mode_numbers(n - 1))
    m, s = np.abs(m), (m < 0).astype(int)
    whole = xp.zeros((len(m),) * 2)
    n_strips = n if xp is np else min(N_STRIPS, n)
    strips = list(pairwise(np.linspace(0, n, n_strips + 1).astype(int).tolist()))

    def put(strip: tuple[int, int], whole: Array) -> Array:
        first, end = strip

        def add(_, number):
            return None, _rows_of_order(number, beams, f, first, end)

        _, rows = scan(xp, add, None, np.arange(first, end))
        start, stop = np.searchsorted(m, (first, end))
        row = ((m - first) * 2 + s) * (n - first) + ell - first
        column = (s * end + m) * n + ell
        rows = rows.reshape(-1, rows.shape[-1])[row[start:stop][:, None], column[:stop][None]]
        return placed(whole, (slice(start, stop), slice(stop)), rows)

    for strip in strips:
        whole = put(strip, whole)
    return whole


def places(lmax: int) -> Int[np.ndarray, " modes"]:
    """Rows of the packed modes: by growing ``|m|``, for each first the a_lm, then the a_l,-m."""
    return np.argsort(_by_order(lmax))


@lru_cache(maxsize=4)
def _by_order(lmax: int) -> Int[np.ndarray, " modes"]:
    ell, m = mode_numbers(lmax)
    return np.lexsort((ell, m < 0, np.abs(m)))


def _rows_of_order(
    m: Array,
    beams: Float[Array, "orders products 2 functions degrees"],
    f: Complex[Array, "..."],
    first: int,
    end: int,
) -> Float[Array, "rows columns"]:
    """Rows a_lm, then a_l,-m, of one order; columns a_l'm', then a_l',-m', of orders below end.

    Rows of degrees from ``first``; columns of all degrees, with zeros where there is no mode.
    """
    xp, n, others = namespace(beams, f), beams.shape[0], np.arange(end)
    difference = xp.take(f, m - others + 2 * (n - 1), axis=-1)
    total = xp.take(f, m + others + 2 * (n - 1), axis=-1)
    plus, minus = _weighted((total + difference) / 2.0, (total - difference) / 2.0, beams[:end])
    real, imaginary = own = beams[m][..., first:].swapaxes(0, 1)
    # real and imaginary parts of complex products by products of real matrices
    both = xp.concatenate([xp.stack([real, -imaginary], 1), xp.stack([imaginary, real], 1)], -1)
    both = both.reshape(-1, 2 * own.shape[-1]).T
    # (rows, orders, degrees) of either
    u, v = ((both @ x).swapaxes(0, 1) for x in (plus, minus))
    r = n - first
    u, v = u.reshape(2 * r, -1), v.reshape(2 * r, -1)
    return xp.concatenate([xp.concatenate([u[:r], -v[r:]], 1), xp.concatenate([u[r:], v[:r]], 1)])


def _weighted(
    even: Complex[Array, "..."],
    odd: Complex[Array, "..."],
    beams: Float[Array, "orders products 2 functions degrees"],
) -> list[Float[Array, "orders parts degrees"]]:
    """(P + Q) / 2 and (P - Q) / 2 without the row's own beam, real and imaginary parts.

    With the other beam W + i W', and F(m + m') + F(m - m') = 2 even, their difference 2 odd::

        (P + Q) / 2 = even W + i odd W',    (P - Q) / 2 = -odd W - i even W'.
    """
    xp, (n_orders, n_products, _, n_functions, n) = namespace(even, beams), beams.shape
    factors = [
        xp.stack([xp.stack([even.real, -odd.imag]), xp.stack([even.imag, odd.real])]),
        xp.stack([xp.stack([-odd.real, even.imag]), xp.stack([-odd.imag, -even.real])]),
    ]
    if even.ndim == 5:
        # part, other part, product, other product, function, other function, order
        factors = [x.transpose(6, 2, 0, 4, 3, 1, 5) for x in factors]
        factors = [x.reshape(n_orders, n_products * 2 * n_functions, -1) for x in factors]
        return [x @ beams.reshape(n_orders, -1, n) for x in factors]
    beams = beams.reshape(n_orders, n_products, -1, n)
    factors = [x.transpose(5, 2, 0, 3, 1, 4).reshape(*beams.shape[:3], -1) for x in factors]
    if xp is np:
        products = [x @ beams for x in factors]
    else:  # XLA multiplies many small matrices a sixth as fast as it adds these terms
        products = [
            sum(x[..., q, None] * beams[:, :, None, q] for q in range(beams.shape[2]))
            for x in factors
        ]
    return [x.reshape(n_orders, -1, n) for x in products]
