"""One text for NumPy and for JAX.

What prepares a run needs neither derivatives nor a GPU, and compiling it takes a thousand times
longer than computing it. Functions that may also be differentiated are written once, with the array
namespace of their input (as in the array API standard): of NumPy arrays they make NumPy arrays at
once; of JAX arrays and tracers they make JAX arrays, in one compiled program.

JAX keeps compiled programs from one run to the next in the user's cache folder
(:func:`use_compilation_cache`). ``LUSEE_BAYES_CACHE`` names another folder, or says ``off``; a
cache that JAX itself has been told to use is left alone.
"""

from __future__ import annotations

import hashlib
import os
import platform
from collections.abc import Callable, Mapping
from functools import wraps
from pathlib import Path
from types import ModuleType
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float
from platformdirs import user_cache_path

Array = jax.Array | np.ndarray
# arrays that recur, with their shapes
DataVector = Float[Array, " data"]
Grid = Float[Array, "products times"]
Times = Float[np.ndarray, " times"]
Rows = Float[np.ndarray, " rows"]
RowFlags = Bool[np.ndarray, " rows"]
GridFlags = Bool[np.ndarray, "products times"]
TimeFlags = Bool[np.ndarray, " times"]
Modes = Float[Array, " modes"]
# of one field, or of any number of fields
Fields = Float[Array, "*batch modes"]
ModesMatrix = Float[Array, "modes modes"]
Draws = Float[np.ndarray, "draws modes"]
Ells = Float[np.ndarray, " ells"]
Pixels = Float[np.ndarray, " pixels"]
Vector = Float[np.ndarray, " n"]
Square = Float[np.ndarray, "n n"]
# of parameters, by name
Values = Mapping[str, float | Float[Array, ""]]

F = TypeVar("F", bound=Callable[..., Any])
T = TypeVar("T")


def namespace(*arrays: Any) -> ModuleType:
    """Return jax.numpy if one of the arrays, or of the leaves of trees, is JAX's; else numpy."""
    return jnp if _of_jax(arrays) else np


def as_complex(real: Array, imaginary: Array) -> Array:
    """Return real + i imaginary."""
    if namespace(real, imaginary) is np:
        return real + 1j * imaginary
    return jax.lax.complex(jnp.asarray(real), jnp.asarray(imaginary))


def scalar(value: Any) -> Array:
    """Convert a number to a float64 array of JAX: a run value that it traces, not structure."""
    return jnp.asarray(value, dtype=jnp.float64)


def compiled(function: F) -> F:
    """Compile a function for JAX arrays; with NumPy arrays alone it runs as it is.

    Other arguments than arrays are constants of the program.
    """
    jitted = eqx.filter_jit(function)

    @wraps(function)
    def either(*args: Any, **kwargs: Any) -> Any:
        return (jitted if _of_jax((args, kwargs)) else function)(*args, **kwargs)

    return either


def placed(array: Array, where: Any, values: Array) -> Array:
    """Return the array with values at an index; a NumPy array is changed in place."""
    if namespace(array, values) is not np:
        return array.at[where].set(values)
    array[where] = values
    return array


def on_device(tree: T) -> T:
    """Return the same tree with JAX arrays in place of NumPy's."""
    return jax.tree.map(lambda x: jnp.asarray(x) if isinstance(x, np.ndarray) else x, tree)


def on_host(tree: T) -> T:
    """Return the same tree with NumPy arrays in place of JAX's, on a CPU without copying them."""
    return jax.tree.map(lambda x: np.asarray(x) if isinstance(x, jax.Array) else x, tree)


def _of_jax(tree: Any) -> bool:
    return any(isinstance(leaf, jax.Array) for leaf in jax.tree.leaves(tree))


SWITCH, OFF = "LUSEE_BAYES_CACHE", "off"
# the level of XLA's messages, and what JAX sets where it is imported before this package: XLA then
# warns of every program that it finds in the cache, in red
MESSAGES, CHATTY = "TF_CPP_MIN_LOG_LEVEL", "1"
SETTINGS = {
    # a map needs some 10 MB; the size makes JAX lock the folder, which several processes may use
    "jax_compilation_cache_max_size": 500_000_000,
    "jax_persistent_cache_min_compile_time_secs": 0.0,
    "jax_persistent_cache_min_entry_size_bytes": -1,
    # the names of XLA's own caches, which lie in the folder, would enter the names of programs
    "jax_persistent_cache_enable_xla_caches": "none",
}


def use_compilation_cache() -> None:
    """Let JAX keep what it compiles from now on.

    Does nothing where JAX was imported before this package: XLA would warn of every program that it
    finds, and reads the level of its messages no more.
    """
    wanted = os.environ.get(SWITCH, "")
    is_set = jax.config.jax_compilation_cache_dir is not None
    if is_set or wanted == OFF or os.environ.get(MESSAGES) == CHATTY:
        return
    folder = (Path(wanted) if wanted else user_cache_path("lusee_bayes")) / "programs" / _machine()
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        # a home that cannot be written to: programs are compiled anew
        return
    for name, value in {**SETTINGS, "jax_compilation_cache_dir": str(folder)}.items():
        jax.config.update(name, value)


def _machine() -> str:
    """A name for what programs are compiled for: those of one processor may fail on another."""
    features, info = platform.processor(), Path("/proc/cpuinfo")
    if info.is_file():
        lines = info.read_text(encoding="utf-8").splitlines()
        features = next((x for x in lines if x.startswith(("flags", "Features"))), features)
    return hashlib.sha256(f"{platform.machine()} {features}".encode()).hexdigest()[:16]
