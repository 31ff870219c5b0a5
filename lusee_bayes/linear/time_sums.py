"""Sums over times of weights, powers of the tilt and exp(i q phi): all of time in A^T N^-1 A.

::

    F_c,ab(q) = sum_t w_c(t) (-ex)^a (-ey)^b exp(i q phi(t)),    q = -2 lmax .. 2 lmax

They are the only part of a normal matrix whose cost grows with the number of samples, and a small
part of its cost.
"""

from __future__ import annotations

from math import factorial

import numpy as np
from jaxtyping import Complex, Float

from lusee_bayes.core.arrays import Array, as_complex, namespace, scan
from lusee_bayes.core.rotations import tilt_powers

# times that are summed at once: it bounds the memory
CHUNK = 512


def time_sums(
    weights: Float[Array, "weights times"],
    azimuth: Float[Array, " times"],
    tilt: Float[Array, "times 2"],
    order: int,
    lmax: int,
) -> Complex[Array, "weights powers powers q"]:
    """Compute F for every pair of powers of the tilt, divided by the factorials of both.

    Parameters
    ----------
    weights : (weights, times) array
        w_c(t), in 1/K^2 where they are inverse variances.
    azimuth : (times,) array
        phi(t), in radians.
    tilt : (times, 2) array
        ex and ey, in radians.
    order : int
        Highest power of the tilt.
    lmax : int
        Highest order m of either beam.

    Returns
    -------
    (weights, powers, powers, 4 lmax + 1) complex array
        The last axis counts q from -2 lmax to 2 lmax. In the unit of ``weights``.
    """
    powers = tilt_powers(2 * order)
    n_chunks = -(-azimuth.shape[0] // CHUNK)
    missing = n_chunks * CHUNK - azimuth.shape[0]

    xp = namespace(weights, azimuth, tilt)

    def chunked(x: Array) -> Array:
        padded = xp.pad(x, ((0, missing), *((0, 0),) * (x.ndim - 1)))
        return padded.reshape(n_chunks, CHUNK, *x.shape[1:])

    def add(total, part):
        w, phi, e = part
        ex, ey = -e[:, 0], -e[:, 1]
        monomials = xp.stack([ex**a * ey**b for a, b in powers])
        angle = phi[:, None] * np.arange(2.0 * lmax + 1.0)[None]
        phases = xp.concatenate([xp.cos(angle), xp.sin(angle)], axis=1)
        weighted = (w.T[:, None] * monomials[None]).reshape(-1, CHUNK)
        return total + weighted @ phases, None

    start = xp.zeros((weights.shape[0] * len(powers), 2 * (2 * lmax + 1)))
    parts = (chunked(weights.T), chunked(azimuth), chunked(tilt))
    sums, _ = scan(xp, add, start, parts)
    cosine, sine = xp.split(sums.reshape(weights.shape[0], len(powers), -1), 2, axis=-1)
    positive = as_complex(cosine, sine)
    full = xp.concatenate([positive[..., :0:-1].conj(), positive], axis=-1)
    table, scale = _pairs(order)
    return full[:, table] * scale.astype(full.dtype)[None, :, :, None]


def _pairs(order: int) -> tuple[np.ndarray, np.ndarray]:
    """For two powers of the tilt: which monomial their product is, and 1 / (n! n'!)."""
    powers = tilt_powers(order)
    place = {power: i for i, power in enumerate(tilt_powers(2 * order))}
    table = np.array([[place[a + c, b + d] for c, d in powers] for a, b in powers])
    inverse = np.array([1.0 / factorial(a + b) for a, b in powers])
    return table, np.outer(inverse, inverse)
