"""The same functions for NumPy and for JAX.

Preparing a run needs neither derivatives nor a GPU, and compiling it takes a thousand times longer
than computing it. Functions that may also be differentiated are written once, with the array
namespace of their input (as in the array API standard). They return NumPy arrays for NumPy arrays,
without compiling, and JAX arrays for JAX arrays and tracers, from one compiled program.

JAX keeps compiled programs from one run to the next in the user's cache folder
(:func:`use_compilation_cache`). ``LUSEE_BAYES_CACHE`` names another folder, or is ``off``. A cache
that is configured in JAX itself takes precedence.
"""

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
# recurring array types, with their shapes
DataVector = Float[Array, " data"]
Grid = Float[Array, "products times"]
Times = Float[np.ndarray, " times"]
Rows = Float[np.ndarray, " rows"]
RowFlags = Bool[np.ndarray, " rows"]
GridFlags = Bool[np.ndarray, "products times"]
TimeFlags = Bool[np.ndarray, " times"]
Modes = Float[Array, " modes"]
# coefficients of one field or of several
Fields = Float[Array, "*batch modes"]
ModesMatrix = Float[Array, "modes modes"]
Draws = Float[np.ndarray, "draws modes"]
Ells = Float[np.ndarray, " ells"]
Pixels = Float[np.ndarray, " pixels"]
Vector = Float[np.ndarray, " n"]
Square = Float[np.ndarray, "n n"]
# parameter values by name
Values = Mapping[str, float | Float[Array, ""]]

F = TypeVar("F", bound=Callable[..., Any])
T = TypeVar("T")


def read_only(*arrays: np.ndarray) -> tuple[np.ndarray, ...]:
    """The same arrays, which nobody can change: they are kept for others."""
    for one in arrays:
        one.setflags(write=False)
    return arrays


def namespace(*arrays: Any) -> ModuleType:
    """Return jax.numpy if any array, or any leaf of a tree, is a JAX array; else numpy."""
    return jnp if _of_jax(arrays) else np


def as_complex(real: Array, imaginary: Array) -> Array:
    """Return real + i imaginary."""
    if namespace(real, imaginary) is np:
        return real + 1j * imaginary
    return jax.lax.complex(jnp.asarray(real), jnp.asarray(imaginary))


def scalar(value: Any) -> Array:
    """Convert a number to a float64 JAX array: a value that JAX traces, not part of the program."""
    return jnp.asarray(value, dtype=jnp.float64)


def compiled(function: F) -> F:
    """Compile a function for JAX arrays; with NumPy arrays only, run it without compiling.

    Arguments other than arrays are constants of the program.
    """
    jitted = eqx.filter_jit(function)

    @wraps(function)
    def either(*args: Any, **kwargs: Any) -> Any:
        return (jitted if _of_jax((args, kwargs)) else function)(*args, **kwargs)

    return either


def placed(array: Array, where: Any, values: Array) -> Array:
    """Return the array with values set at an index; a NumPy array is changed in place."""
    if namespace(array, values) is not np:
        return array.at[where].set(values)
    array[where] = values
    return array


def on_device(tree: T) -> T:
    """Return the tree with its NumPy arrays converted to JAX arrays."""
    return jax.tree.map(lambda x: jnp.asarray(x) if isinstance(x, np.ndarray) else x, tree)


def on_host(tree: T) -> T:
    """Return the tree with its JAX arrays converted to NumPy arrays, without a copy on a CPU."""
    return jax.tree.map(lambda x: np.asarray(x) if isinstance(x, jax.Array) else x, tree)


def _of_jax(tree: Any) -> bool:
    return any(isinstance(leaf, jax.Array) for leaf in jax.tree.leaves(tree))


SWITCH, OFF = "LUSEE_BAYES_CACHE", "off"
# XLA's log level, and the value that JAX sets if it is imported before this package: XLA then
# warns, in red, about every program that it finds in the cache
MESSAGES, CHATTY = "TF_CPP_MIN_LOG_LEVEL", "1"
SETTINGS = {
    # a map needs some 10 MB; with a size limit JAX locks the folder, so that processes can share it
    "jax_compilation_cache_max_size": 500_000_000,
    "jax_persistent_cache_min_compile_time_secs": 0.0,
    "jax_persistent_cache_min_entry_size_bytes": -1,
    # the paths of XLA's own caches, inside this folder, would become part of the programs' names
    "jax_persistent_cache_enable_xla_caches": "none",
}


def use_compilation_cache() -> None:
    """Let JAX keep every program that it compiles from now on.

    Does nothing if JAX was imported before this package: XLA would warn about every cached program,
    and no longer reads its log level.
    """
    wanted = os.environ.get(SWITCH, "")
    is_set = jax.config.jax_compilation_cache_dir is not None
    if is_set or wanted == OFF or os.environ.get(MESSAGES) == CHATTY:
        return
    folder = (Path(wanted) if wanted else user_cache_path("lusee_bayes")) / "programs" / _machine()
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        # the home folder is not writable: compile every time
        return
    for name, value in {**SETTINGS, "jax_compilation_cache_dir": str(folder)}.items():
        jax.config.update(name, value)


def _machine() -> str:
    """A name for the processor: programs compiled for one processor may fail on another."""
    features, info = platform.processor(), Path("/proc/cpuinfo")
    if info.is_file():
        lines = info.read_text(encoding="utf-8").splitlines()
        features = next((x for x in lines if x.startswith(("flags", "Features"))), features)
    return hashlib.sha256(f"{platform.machine()} {features}".encode()).hexdigest()[:16]
