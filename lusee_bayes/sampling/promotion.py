"""NumPyro under strict rules of JAX."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import jax


@contextmanager
def numpyro_promotion() -> Iterator[None]:
    """Allow JAX's standard promotion of types and ranks.

    NumPyro's own code mixes types and ranks, whatever rules are set for ours. Use it around calls
    of NumPyro, or as the decorator ``@numpyro_promotion()`` of functions that make them.
    """
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        yield
