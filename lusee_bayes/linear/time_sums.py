"""Sums over times of weights, pairs of functions and exp(i q phi): all of time in A^T N^-1 A.

::

    F_c,jk(q) = sum_t w_c(t) u_j(t) u_k(t) exp(i q phi(t)),    q = -2 lmax .. 2 lmax

They are the only part of a normal matrix whose cost grows with the number of samples, and a small
part of its cost.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Complex, Float

from lusee_bayes.core.arrays import Array, as_complex, namespace, scan

# times that are summed at once: it bounds the memory
CHUNK = 512


def time_sums(
    weights: Float[Array, "weights times"],
    azimuth: Float[Array, " times"],
    functions: Float[Array, "times functions"],
    lmax: int,
) -> Complex[Array, "weights functions functions q"]:
    """Compute F for every pair of functions of time.

    Parameters
    ----------
    weights : (weights, times) array
        w_c(t), in 1/K^2 where they are inverse variances.
    azimuth : (times,) array
        phi(t), in radians.
    functions : (times, functions) array
        u_j(t).
    lmax : int
        Highest order m of either beam.

    Returns
    -------
    (weights, functions, functions, 4 lmax + 1) complex array
        The last axis counts q from -2 lmax to 2 lmax. In the unit of ``weights``.
    """
    n = functions.shape[1]
    left, right = np.triu_indices(n)
    n_chunks = -(-azimuth.shape[0] // CHUNK)
    missing = n_chunks * CHUNK - azimuth.shape[0]

    xp = namespace(weights, azimuth, functions)

    def chunked(x: Array) -> Array:
        padded = xp.pad(x, ((0, missing), *((0, 0),) * (x.ndim - 1)))
        return padded.reshape(n_chunks, CHUNK, *x.shape[1:])

    def add(total, part):
        w, phi, u = part
        pairs = u[:, left] * u[:, right]
        angle = phi[:, None] * np.arange(2.0 * lmax + 1.0)[None]
        phases = xp.concatenate([xp.cos(angle), xp.sin(angle)], axis=1)
        weighted = (w.T[:, None] * pairs.T[None]).reshape(-1, CHUNK)
        return total + weighted @ phases, None

    start = xp.zeros((weights.shape[0] * len(left), 2 * (2 * lmax + 1)))
    parts = (chunked(weights.T), chunked(azimuth), chunked(functions))
    sums, _ = scan(xp, add, start, parts)
    cosine, sine = xp.split(sums.reshape(weights.shape[0], len(left), -1), 2, axis=-1)
    positive = as_complex(cosine, sine)
    full = xp.concatenate([positive[..., :0:-1].conj(), positive], axis=-1)
    place = np.zeros((n, n), dtype=int)
    place[left, right] = place[right, left] = np.arange(len(left))
    return xp.take(full, place, axis=1)
