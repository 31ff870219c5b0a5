"""Bad input: one clear sentence, raised where it enters.

Values can be checked only when they are known: inside a JAX transformation an array is a
tracer, and the value checks below pass it through (its dtype and shape are still checked).
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable
from typing import Any

import jax
import numpy as np

AnyArray = jax.Array | np.ndarray


class InputError(ValueError):
    """Something a user supplied cannot be used. The message says what, where and what to do."""


class ProcessLost(RuntimeError):
    """Another process of this run has ended, so that this one cannot go on."""


def is_traced(*arrays: Any) -> bool:
    """True if any of ``arrays`` is a tracer, so that its values are not known yet."""
    return any(isinstance(a, jax.core.Tracer) for a in arrays)


def require_float64(name: str, array: Any) -> None:
    """Refuse anything but 64-bit floats: Lambda's condition number is about 1e10."""
    dtype = getattr(array, "dtype", None)
    if dtype != np.float64:
        got = f"an array of {dtype}" if dtype is not None else f"a {type(array).__name__}"
        raise InputError(
            f"{name} must be a float64 array, got {got}; convert it with "
            "numpy.asarray(x, dtype=numpy.float64)"
        )


def require_shape(name: str, array: Any, shape: tuple[int | None, ...]) -> None:
    """Refuse an array whose shape is not ``shape``; None stands for any length."""
    got = tuple(array.shape)
    fits = len(got) == len(shape) and all(
        s is None or s == g for s, g in zip(shape, got, strict=True)
    )
    if not fits:
        expected = str(shape).replace("None", "any")
        raise InputError(f"{name} has shape {got}, expected {expected}")


def _first_offenders(bad: np.ndarray) -> str:
    where = np.argwhere(np.atleast_1d(bad))
    shown = ", ".join(str(tuple(int(i) for i in w)) for w in where[:3])
    return f"{len(where)} of {bad.size} entries, first at {shown}"


def require_finite(name: str, array: Any) -> None:
    """Refuse NaN and infinity; nothing is ever filled in for them."""
    if is_traced(array):
        return
    bad = ~np.isfinite(np.asarray(array))
    if bad.any():
        raise InputError(
            f"{name} holds NaN or infinity ({_first_offenders(bad)}); "
            "flag missing samples instead of storing a value for them"
        )


def require_positive(name: str, array: Any, hint: str = "") -> None:
    """Refuse zero, negative and non-finite entries."""
    if is_traced(array):
        return
    values = np.asarray(array)
    bad = ~(values > 0) | ~np.isfinite(values)
    if bad.any():
        detail = f"got {values}" if values.ndim == 0 else f"fails at {_first_offenders(bad)}"
        raise InputError(f"{name} must be positive, {detail}" + (f"; {hint}" if hint else ""))


# |N - N^T| of a matrix that was meant to be symmetric is rounding, relative to its largest entry
SYMMETRY_TOLERANCE = 1e-12


def require_symmetric(name: str, matrices: Any) -> None:
    """Refuse a matrix, or a stack of them, that differs from its transpose."""
    if is_traced(matrices):
        return
    values = np.asarray(matrices)
    largest = float(np.abs(values).max())
    asymmetry = float(np.abs(values - np.swapaxes(values, -1, -2)).max())
    if asymmetry > SYMMETRY_TOLERANCE * largest:
        raise InputError(
            f"{name} is not symmetric: entries differ by up to {asymmetry:.3g} from their mirror "
            f"images (largest entry {largest:.3g}); give (N + N.T) / 2 if that is what you mean"
        )


def nearest(word: str, known: Iterable[str]) -> str:
    """A hint naming the closest of ``known``, or all of them if none is close."""
    known = list(known)
    close = difflib.get_close_matches(word, known, n=1, cutoff=0.5)
    return f"did you mean '{close[0]}'?" if close else f"known: {', '.join(sorted(known))}"
