"""W^T W at less than the cost of a general product.

XLA has no symmetric rank-k update on the CPU: ``W.T @ W`` computes both triangles. Splitting the
columns and forming only the blocks on and below the diagonal does 5/8 of the work.
"""

from __future__ import annotations

from itertools import pairwise

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

# measured at 5232 x 2304 on two cores: 4 blocks 0.40 s, one product 0.49 s; halving recursively
# takes 0.35 s but 0.1 GB more memory
N_BLOCKS = 4


def gram(w: Float[Array, "rows columns"]) -> Float[Array, "columns columns"]:
    """W^T W, symmetric to the last bit."""
    return symmetric_product(w.T, w)


def symmetric_product(
    left: Float[Array, "n inner"], right: Float[Array, "inner n"]
) -> Float[Array, "n n"]:
    """The product of two matrices where that is symmetric, symmetric to the last bit."""
    n = right.shape[1]
    edges = np.linspace(0, n, N_BLOCKS + 1).astype(int)
    rows = []
    for first, end in pairwise(edges):
        block = left[first:end] @ right[:, :end]
        rows.append(jnp.pad(block, ((0, 0), (0, n - end))))
    lower = jnp.tril(jnp.concatenate(rows, axis=0))
    return lower + jnp.tril(lower, -1).T
