"""Input checks that raise one clear sentence at the point where bad input enters.

Inside a JAX transformation, an array is a tracer without known values. Checks of values then let it
pass; checks of dtype and shape still apply.

A :class:`Described` object describes itself in about three lines, for a prompt or a notebook.
"""

from abc import abstractmethod
from typing import Any

import numpy as np

from lusee_bayes.core.errors import InputError, refusing
from lusee_bayes.core.lazy import jax


def is_traced(*arrays: Any) -> bool:
    """Return whether any of ``arrays`` is a tracer, whose values are not known yet."""
    return any(isinstance(a, jax.core.Tracer) for a in arrays)


def in_unit(name: str, value: Any, unit: str) -> Any:
    """Return the number of an astropy Quantity in this unit; anything else as it is.

    Raises
    ------
    InputError
        If the Quantity has a unit of another kind.
    """
    if not hasattr(value, "to_value"):
        return value
    with refusing(f"{name} is in '{value.unit}', expected {unit}", TypeError, ValueError):
        return value.to_value(unit)


def require_whole(name: str, value: Any, least: int, most: int) -> None:
    """Check that a number is an integer within a range.

    Parameters
    ----------
    name : str
        Name of the number, for the error message.
    value : object
    least, most : int

    Raises
    ------
    InputError
        If it is not; C libraries may crash the process on such a number.
    """
    whole = isinstance(value, (int, np.integer)) and not isinstance(value, bool)
    if not (whole and least <= value <= most):
        raise InputError(f"{name} is {value!r}, expected a whole number from {least} to {most}")


def require_plain(name: str, array: Any) -> None:
    """Check that an array has no unit and no mask, which NumPy would drop without a word.

    Raises
    ------
    InputError
        If it has.
    """
    for extra in ("unit", "mask"):
        if hasattr(array, extra):
            raise InputError(f"{name} has a {extra}; give plain numbers in the documented unit")


def require_float64(name: str, array: Any) -> None:
    """Check that an array is float64; Lambda's condition number is about 1e10.

    Parameters
    ----------
    name : str
        Name of the array, for the error message.
    array : object

    Raises
    ------
    InputError
        If it is not an array of float64, or has a unit or a mask.
    """
    require_plain(name, array)
    if (dtype := getattr(array, "dtype", None)) != np.float64:
        got = f"an array of {dtype}" if dtype is not None else f"a {type(array).__name__}"
        raise InputError(f"{name} must be a float64 array, got {got}; use x.astype(numpy.float64)")


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
        raise InputError(f"{name} has shape {got}, expected {str(shape).replace('None', 'any')}")


def _first_offenders(bad: np.ndarray) -> str:
    where = np.argwhere(np.atleast_1d(bad))
    shown = ", ".join(str(tuple(int(i) for i in w)) for w in where[:3])
    return f"{len(where)} of {bad.size} entries, first at {shown}"


def require_finite(name: str, array: Any) -> None:
    """Check that an array contains no NaN or infinity.

    Parameters
    ----------
    name : str
        Name of the array, for the error message.
    array : array
        Not checked if it is a tracer.

    Raises
    ------
    InputError
        If an entry is not finite; the message lists the first such entries.
    """
    if not is_traced(array) and (bad := ~np.isfinite(np.asarray(array))).any():
        wrong = f"{name}: NaN or infinity ({_first_offenders(bad)}); flag missing samples instead"
        raise InputError(wrong)


def require_array(name: str, array: Any, shape: tuple[int | None, ...] | None = None) -> None:
    """Check that an array is float64 and finite and, if a shape is given, has that shape.

    Parameters
    ----------
    name, array, shape
        As in :func:`require_float64`, :func:`require_shape` and :func:`require_finite`.

    Raises
    ------
    InputError
        As in these functions.
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
        Advice to append to the message.

    Raises
    ------
    InputError
        If an entry is zero, negative or not finite, or has a unit.
    """
    if is_traced(array):
        return
    require_plain(name, array)
    values = np.asarray(array)
    if (bad := ~(values > 0) | ~np.isfinite(values)).any():
        detail = f"got {values}" if values.ndim == 0 else f"fails at {_first_offenders(bad)}"
        raise InputError(f"{name} must be positive, {detail}" + (f"; {hint}" if hint else ""))


# largest difference by rounding between a symmetric matrix and its transpose, relative to the
# largest entry
SYMMETRY_TOLERANCE = 1e-12


def require_symmetric(name: str, matrices: Any) -> None:
    """Check that a matrix, or every matrix of a stack, is symmetric.

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
    """An object that describes itself: its kind, shapes, units, frequencies and dates.

    Dataclasses need ``repr=False``; otherwise they generate their own representation.
    """

    @abstractmethod
    def description(self) -> tuple[str, ...]:
        """Return a few lines: first the kind of object, then its contents."""

    def __repr__(self) -> str:
        return f"{type(self).__name__}: " + "\n  ".join(self.description())


def number(value: Any, form: str = ".6g") -> str:
    """Format a number; a tracer, whose value is unknown, becomes ``traced``."""
    return "traced" if is_traced(value) else format(float(value), form)


def with_error(value: float, std: float) -> str:
    """Format a value and its standard deviation, both to the second digit of the latter."""
    digits = max(0, 1 - int(np.floor(np.log10(std)))) if std > 0.0 else 4
    return f"{value:.{digits}f} +- {std:.{digits}f}"


def extent(values: Any, unit: str, form: str = ".4g") -> str:
    """Format the range of some numbers, with their unit."""
    if is_traced(values):
        return f"values in {unit}, traced"
    values = np.asarray(values)
    return f"{values.min():{form}} to {values.max():{form}} {unit}"


def listed(names: tuple[str, ...], shown: int = 4) -> str:
    """Join names with commas; of a long list, omit the middle."""
    if len(names) <= 2 * shown:
        return ", ".join(names)
    return ", ".join([*names[:shown], "...", *names[-2:]])


def counted(n: int, one: str, several: str = "") -> str:
    """Return a number with its noun: 1 session, 2 sessions."""
    return f"{n} {one if n == 1 else several or f'{one}s'}"
