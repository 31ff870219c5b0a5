"""One text for NumPy and for JAX.

What prepares a run needs neither derivatives nor a GPU, and compiling it takes a thousand times
longer than computing it. Functions that may also be differentiated are written once, with the
array namespace of their input (as in the array API standard): of NumPy arrays they make NumPy
arrays at once; of JAX arrays and tracers they make JAX arrays, in one compiled program.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from types import ModuleType
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

Array = jax.Array | np.ndarray

F = TypeVar("F", bound=Callable[..., Any])
T = TypeVar("T")


def namespace(*arrays: Any) -> ModuleType:
    """Return jax.numpy if one of the arrays, or of the leaves of trees, is JAX's; else numpy."""
    return jnp if _of_jax(arrays) else np


def compiled(function: F) -> F:
    """Compile a function for JAX arrays; with NumPy arrays alone it runs as it is.

    Other arguments than arrays are constants of the program.
    """
    jitted = eqx.filter_jit(function)

    @wraps(function)
    def either(*args: Any, **kwargs: Any) -> Any:
        return (jitted if _of_jax((args, kwargs)) else function)(*args, **kwargs)

    return either


def on_device(tree: T) -> T:
    """Return the same tree with JAX arrays in place of NumPy's."""
    return jax.tree.map(lambda x: jnp.asarray(x) if isinstance(x, np.ndarray) else x, tree)


def _of_jax(tree: Any) -> bool:
    return any(isinstance(leaf, jax.Array) for leaf in jax.tree.leaves(tree))
