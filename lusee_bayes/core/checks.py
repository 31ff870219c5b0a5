"""Checks of input that raise one clear sentence where bad input enters.

Inside a JAX transformation an array is a tracer and its values are not known: the checks of values
pass it through, those of dtype and shape do not.

An object that is :class:`Described` says what it is in about three lines, for a prompt and for a
notebook.
"""

from __future__ import annotations

from abc import abstractmethod
from typing import Any

import numpy as np

from lusee_bayes.core.errors import InputError
from lusee_bayes.core.lazy import jax


def is_traced(*arrays: Any) -> bool:
    """Return whether any of ``arrays`` is a tracer, whose values are not known yet."""
    return any(isinstance(a, jax.core.Tracer) for a in arrays)


def require_whole(name: str, value: Any, least: int, most: int) -> None:
    """Check that a number is whole and in a range.

    Parameters
    ----------
    name : str
        Name of the number, for the error message.
    value : object
    least, most : int

    Raises
    ------
    InputError
        If it is not; libraries in C may end the process for such a number.
    """
    whole = isinstance(value, (int, np.integer)) and not isinstance(value, bool)
    if not (whole and least <= value <= most):
        raise InputError(f"{name} is {value!r}, expected a whole number from {least} to {most}")


def require_float64(name: str, array: Any) -> None:
    """Check that an array holds 64-bit floats; Lambda's condition number is about 1e10.

    Parameters
    ----------
    name : str
        Name of the array, for the error message.
    array : object

    Raises
    ------
    InputError
        If it is not an array of float64.
    """
    dtype = getattr(array, "dtype", None)
    if dtype != np.float64:
        got = f"an array of {dtype}" if dtype is not None else f"a {type(array).__name__}"
        raise InputError(
            f"{name} must be a float64 array, got {got}; convert it with "
            "numpy.asarray(x, dtype=numpy.float64)"
        )


def require_shape(name: str, array: Any, shape: tuple[int | None, ...]) -> None:
    """Check the shape of an array.

    Parameters
    ----------
    name : str
        Name of the array, for the error message.
    array : array
    shape : tuple of int or None
        The expected shape; None stands for any length.

    Raises
    ------
    InputError
        If the shape differs.
    """
    got = tuple(array.shape)
    if len(got) != len(shape) or any(s not in (None, g) for s, g in zip(shape, got, strict=True)):
        expected = str(shape).replace("None", "any")
        raise InputError(f"{name} has shape {got}, expected {expected}")


def _first_offenders(bad: np.ndarray) -> str:
    where = np.argwhere(np.atleast_1d(bad))
    shown = ", ".join(str(tuple(int(i) for i in w)) for w in where[:3])
    return f"{len(where)} of {bad.size} entries, first at {shown}"


def require_finite(name: str, array: Any) -> None:
    """Check that an array holds no NaN and no infinity.

    Parameters
    ----------
    name : str
        Name of the array, for the error message.
    array : array
        Not checked if it is a tracer.

    Raises
    ------
    InputError
        If an entry is not finite; the message names the first ones.
    """
    if is_traced(array):
        return
    bad = ~np.isfinite(np.asarray(array))
    if bad.any():
        raise InputError(
            f"{name}: NaN or infinity ({_first_offenders(bad)}); flag missing samples instead"
        )


def require_array(name: str, array: Any, shape: tuple[int | None, ...] | None = None) -> None:
    """Check that an array holds finite 64-bit floats, and its shape where one is given.

    Parameters
    ----------
    name, array, shape
        As of :func:`require_float64`, :func:`require_shape` and :func:`require_finite`.

    Raises
    ------
    InputError
        As these do.
    """
    require_float64(name, array)
    if shape is not None:
        require_shape(name, array, shape)
    require_finite(name, array)


def require_positive(name: str, array: Any, hint: str = "") -> None:
    """Check that every entry is positive and finite.

    Parameters
    ----------
    name : str
        Name of the value or array, for the error message.
    array : float or array
        Not checked if it is a tracer.
    hint : str
        What to do about it, added to the message.

    Raises
    ------
    InputError
        If an entry is zero, negative or not finite.
    """
    if is_traced(array):
        return
    values = np.asarray(array)
    bad = ~(values > 0) | ~np.isfinite(values)
    if bad.any():
        detail = f"got {values}" if values.ndim == 0 else f"fails at {_first_offenders(bad)}"
        raise InputError(f"{name} must be positive, {detail}" + (f"; {hint}" if hint else ""))


# a matrix that is meant to be symmetric differs from its transpose by rounding, relative to its
# largest entry
SYMMETRY_TOLERANCE = 1e-12


def require_symmetric(name: str, matrices: Any) -> None:
    """Check that a matrix, or each of a stack, is symmetric.

    Parameters
    ----------
    name : str
        Name of the matrix, for the error message.
    matrices : (..., n, n) array
        Not checked if it is a tracer.

    Raises
    ------
    InputError
        If entries differ from their mirror images by more than rounding.
    """
    if is_traced(matrices):
        return
    values = np.asarray(matrices)
    largest = float(np.abs(values).max())
    asymmetry = float(np.abs(values - np.swapaxes(values, -1, -2)).max())
    if asymmetry > SYMMETRY_TOLERANCE * largest:
        raise InputError(
            f"{name} is not symmetric: entries differ by up to {asymmetry:.3g} from their mirror "
            f"images (largest entry {largest:.3g}); use (N + N.T) / 2 to symmetrise it"
        )


class Described:
    """An object that says what it is: its kind, shapes, units, frequencies, dates.

    Dataclasses need ``repr=False``, or they write a representation of their own.
    """

    @abstractmethod
    def description(self) -> tuple[str, ...]:
        """Return a few lines: first what the object is, then what it holds."""

    def __repr__(self) -> str:
        return f"{type(self).__name__}: " + "\n  ".join(self.description())


def number(value: Any, form: str = ".6g") -> str:
    """Return a number as text; of a tracer, whose value is not known, that it is one."""
    return "traced" if is_traced(value) else format(float(value), form)


def extent(values: Any, unit: str, form: str = ".4g") -> str:
    """Return the smallest and the largest of some numbers with their unit."""
    if is_traced(values):
        return f"values in {unit}, traced"
    values = np.asarray(values)
    return f"{values.min():{form}} to {values.max():{form}} {unit}"


def listed(names: tuple[str, ...], shown: int = 4) -> str:
    """Return names one after the other, the middle of many left out."""
    if len(names) <= 2 * shown:
        return ", ".join(names)
    return ", ".join([*names[:shown], "...", *names[-2:]])


def counted(n: int, one: str, several: str = "") -> str:
    """Return a number with its noun: 1 session, 2 sessions."""
    return f"{n} {one if n == 1 else several or f'{one}s'}"
