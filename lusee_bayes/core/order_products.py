"""Quadratic forms y^T C y in every direction: first to a matrix over orders m, m' on each ring.

On a ring y_lm = lambda_l|m|(theta) f_m(phi), so that C shrinks to a matrix over m and m' of that
ring before any of its points is looked at: N_modes^2 operations a ring, where products with y take
N_modes^2 a point. A ring and its mirror image in the south, where lambda has the sign (-1)^(l + m),
share half of them.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from lusee_bayes.core.harmonics import lmax_of, mode_numbers, polar_functions


def order_products(
    matrix: Float[np.ndarray, "modes modes"], heights: Float[np.ndarray, " rings"]
) -> Float[np.ndarray, "rings orders orders"]:
    """Compute B of every ring, with y^T C y = f(phi)^T B f(phi), f the azimuth functions.

    Parameters
    ----------
    matrix : (modes, modes) array
        C, symmetric, over real harmonics.
    heights : (rings,) array
        theta of each, growing, in radians; symmetric about the equator.

    Returns
    -------
    (rings, orders, orders) array
        Over m = -lmax..lmax; not symmetric: only its sum with the transpose counts.
    """
    lmax = lmax_of(matrix.shape[0])
    # rings from the equator on are in the south
    polar = polar_functions(heights[: (len(heights) + 1) // 2], lmax)
    by_order, first = modes_by_order(lmax)
    ell, m = mode_numbers(lmax)
    polar, odd = polar[:, by_order], ((ell + m) % 2 == 1)[by_order]
    mirrored = np.where(odd, -polar, polar)
    both = np.zeros((2 * lmax + 1, len(heights), 2 * lmax + 1))
    for order, rows in enumerate(np.split(np.arange(len(m)), first[1:])):
        # the matrix is symmetric: those of m < m' count twice, those of m > m' are left out
        begin, starts = rows[0], first[order:] - rows[0]
        here = matrix[by_order[rows]].take(by_order[begin:], axis=1)
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
    return both.transpose(1, 0, 2)


def modes_by_order(lmax: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the packed modes by growing m, and where each m begins."""
    _, m = mode_numbers(lmax)
    by_order = np.argsort(m, kind="stable")
    return by_order, np.searchsorted(m[by_order], np.arange(-lmax, lmax + 1))
