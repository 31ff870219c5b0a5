"""Declared contents of files: names, dimensions, kinds, ranges, optional parts.

A reader declares a :class:`Layout` and passes the unread contents of a file to
:meth:`Layout.checked`. It checks names, kinds, shapes and sizes before it reads any number, and all
numbers before they are used. Every error becomes one sentence with the name of the file.

Files may state units (:func:`factor_to`). An error message points out Hz in place of MHz.
"""

import reprlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, Literal, Protocol, runtime_checkable

import numpy as np

from lusee_bayes.core.errors import InputError, refusing, require_known
from lusee_bayes.core.lazy import units
from lusee_bayes.core.progress import gigabytes, memory_limit

# names of units that astropy does not know
ALIASES = {"kelvin": "K", "degrees": "deg", "seconds": "s"}
# placeholders that software writes for a missing word or unit, in lower case
UNSTATED = ("", "unknown", "unspecified", "none")
# LuSEE-Night's band ends at 50 MHz; larger numbers are in Hz or kHz
LARGEST_MHZ = 1000.0
NOT_HZ = f"expected at most {LARGEST_MHZ:g} MHz; is this Hz? Divide by 1e6"


def factor_to(where: str, unit: str, stated: Any) -> float:
    """Return the factor that converts from a file's unit to the package's.

    Parameters
    ----------
    where : str
        The file and its variable, for the message.
    unit : str
        The package's unit; empty for a quantity without one.
    stated : object
        The file's unit; None or one of :data:`UNSTATED` means the package's unit.

    Raises
    ------
    InputError
        If the unit is unknown or belongs to another quantity.
    """
    stated = stated.decode(errors="replace") if isinstance(stated, bytes) else stated
    text = "" if stated is None else str(stated).strip()
    if not unit or text.lower() in UNSTATED:
        return 1.0
    with refusing(f"{where} has the unit '{text}', expected {unit}; convert it", ValueError):
        return float(units.Unit(ALIASES.get(text, text)).to(unit))


def require_mhz(where: str, mhz: Any) -> None:
    """Check that frequencies are plausible in MHz; InputError if one is too high to be."""
    if (largest := float(np.max(mhz))) > LARGEST_MHZ:
        raise InputError(f"{where}: got {largest:g} MHz, {NOT_HZ}")


Kind = Literal["real", "complex", "integer", "boolean", "text", "word", "time"]
# for each: the accepted kinds of NumPy dtypes, the type to convert to, and its name in messages
KINDS: dict[str, tuple[str, type, str]] = {
    "real": ("fiu", np.float64, "real numbers"),
    "complex": ("fiuc", np.complex128, "complex numbers"),
    "integer": ("iu", np.int64, "whole numbers"),
    "boolean": ("biu", np.bool_, "true or false"),
    "text": ("UST", np.str_, "text"),
    "word": ("UST", np.str_, "text or a whole number"),
    "time": ("M", np.datetime64, "times (such as seconds since 2027-01-01)"),
}

# no quantity in this field is larger in any unit, and fourth powers fit into a 64-bit float
LARGEST = 1e60


@runtime_checkable
class Unread(Protocol):
    """An array in a file, whose numbers are only read by ``numpy.asarray``."""

    shape: tuple[int, ...]
    dtype: np.dtype


@dataclass(frozen=True)
class Unloaded:
    """An array of an open file of which only the header has been read."""

    shape: tuple[int, ...]
    dtype: np.dtype
    load: Callable[[], np.ndarray]

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> np.ndarray:
        return np.asarray(self.load(), dtype=self.dtype if dtype is None else dtype)


@dataclass(frozen=True)
class Variable:
    """An array of a file, or an attribute (:data:`Attribute`).

    Attributes
    ----------
    dims : sequence of str or int
        Names of lengths, which all arrays of the file share, or lengths.
    kind : {"real", "complex", "integer", "boolean", "text", "word", "time"}
        Kind of its values; read as float64, complex128, int64, bool, str or datetime64[ns]. Only
        attributes can be words: text, or an integer that is read as text.
    low, high : float
        Range of its finite numbers, limits included.
    finite : bool
        Whether NaN is an error; infinity is one in any case, unless ``missing``.
    missing : bool
        Whether NaN and infinity are allowed.
    grows : bool
        Whether the numbers must increase strictly.
    choices : sequence of str
        All allowed texts; if empty, any text is allowed.
    optional : bool
        Whether it may be absent.
    unit : str
        The package's unit, in astropy's notation. If the file states another unit, numbers are
        converted from it.
    """

    dims: Sequence[str | int]
    kind: Kind = "real"
    low: float = -LARGEST
    high: float = LARGEST
    finite: bool = True
    missing: bool = False
    grows: bool = False
    choices: Sequence[str] = ()
    optional: bool = False
    unit: str = ""


# a number or text that describes the file: a variable without dimensions
Attribute = partial(Variable, ())


@dataclass(frozen=True)
class Content:
    """The checked contents of a file.

    Attributes
    ----------
    arrays : dict of str to array
        Declared arrays, without absent optional ones.
    values : dict of str to float, int, bool or str
        Declared attributes, without absent optional ones.
    sizes : dict of str to int
        Lengths of dimensions by name.
    names : frozenset of str
        Names of all arrays of the file, declared or not.
    """

    arrays: dict[str, np.ndarray]
    values: dict[str, Any]
    sizes: dict[str, int]
    names: frozenset[str]


@dataclass(frozen=True)
class Layout:
    """Declared contents of one kind of file; anything else in a file is ignored.

    Attributes
    ----------
    what : str
        Description for messages, such as "visibilities of lusee-bayes simulate".
    variables : mapping of str to Variable
    attributes : mapping of str to Variable
    """

    what: str
    variables: Mapping[str, Variable] = field(default_factory=dict)
    attributes: Mapping[str, Variable] = field(default_factory=dict)

    def checked(
        self, path: str | Path, arrays: Mapping[str, Unread], values: Mapping[str, Any]
    ) -> Content:
        """Read the declared contents.

        Parameters
        ----------
        path : str or Path
            The file, for messages.
        arrays : mapping of str to array
            Arrays of the file; numpy.asarray reads their numbers.
        values : mapping of str to object
            Attributes of the file, already read; ``NAME.units`` is the unit stated for an array.

        Returns
        -------
        Content

        Raises
        ------
        InputError
            If something is missing or not as declared.
        """
        for expected, given in ((self.variables, arrays), (self.attributes, values)):
            for name, one in expected.items():
                if not one.optional and given.get(name) is None:
                    has = f"it has {', '.join(map(str, given))}" if len(given) else "it has none"
                    raise InputError(f"{path} has no {name} ({has}); expected {self.what}")
        attributes = {
            name: _checked_value(f"{path}: {name}", values[name], declared)
            for name, declared in self.attributes.items()
            if values.get(name) is not None
        }
        present = {name: declared for name, declared in self.variables.items() if name in arrays}
        sizes: dict[str, int] = {}
        for name, declared in present.items():
            _require_form(f"{path}: {name}", arrays[name], declared, sizes)
        n_bytes = sum(8 * int(np.prod(arrays[n].shape, dtype=object)) for n in present)
        if n_bytes > memory_limit():
            why = f"{path} declares {gigabytes(n_bytes)}; the memory is {gigabytes(memory_limit())}"
            raise InputError(why)
        read = {}
        for name, declared in present.items():
            factor = factor_to(f"{path}: {name}", declared.unit, values.get(f"{name}.units"))
            array = np.asarray(arrays[name])
            read[name] = _checked_array(f"{path}: {name}", array, declared, factor)
        return Content(read, attributes, sizes, frozenset(map(str, arrays)))


def _require_form(where: str, array: Unread, declared: Variable, sizes: dict[str, int]) -> None:
    """Raise InputError if kind or shape differ from the declared ones; add new lengths to sizes."""
    kind, (allowed, _, words) = np.dtype(array.dtype).kind, KINDS[declared.kind]
    # text of variable length is stored as objects
    if kind not in allowed and not (declared.kind == "text" and kind == "O"):
        raise InputError(f"{where} has values of type {array.dtype}, expected {words}")
    shape = tuple(array.shape)
    expected = [sizes.get(d) if isinstance(d, str) else d for d in declared.dims]
    same = len(shape) == len(expected)
    if not (same and all(e in (None, n) for e, n in zip(expected, shape, strict=True))):
        words = " x ".join(
            f"{d}" if e is None or isinstance(d, int) else f"{e} ({d})"
            for d, e in zip(declared.dims, expected, strict=True)
        )
        raise InputError(f"{where} has shape {shape}, expected {words or 'a single value'}")
    if 0 in shape:
        raise InputError(f"{where} is empty, of shape {shape}")
    sizes.update({d: n for d, n in zip(declared.dims, shape, strict=True) if isinstance(d, str)})


def _checked_array(where: str, values: np.ndarray, declared: Variable, factor: float) -> np.ndarray:
    if declared.kind == "text":
        return np.array([_text(where, x, declared) for x in values.ravel()]).reshape(values.shape)
    if declared.kind == "time":
        if np.isnat(values).any():
            first = tuple(np.argwhere(np.isnat(values))[0].tolist())
            raise InputError(f"{where} has no time at {first}")
        return values.astype("datetime64[ns]")
    if declared.kind == "boolean" and not np.isin(values, (0, 1)).all():
        raise InputError(f"{where} has numbers other than 0 and 1, expected true or false")
    values = np.asarray(values, dtype=KINDS[declared.kind][1], order="C")
    if declared.kind == "boolean":
        return values
    values = values if factor == 1.0 else values * factor
    if not declared.missing:
        bad = np.isinf(values) | (np.isnan(values) if declared.finite else False)
        _require_none(where, values, bad, "NaN or infinity" if declared.finite else "infinity")
    low, high = declared.low, declared.high
    if np.isfinite([low, high]).any():
        parts = (values.real, values.imag) if declared.kind == "complex" else (values,)
        outside = np.any([np.isfinite(p) & ((p < low) | (p > high)) for p in parts], axis=0)
        _require_none(where, values, outside, f"a value outside {_range(declared)}")
    if declared.unit == "MHz":
        require_mhz(where, values)
    if declared.grows and not (np.diff(values) > 0).all():
        place = int(np.flatnonzero(~(np.diff(values) > 0))[0])
        wrong = f"{where} does not increase: {values[place + 1]:.12g} follows {values[place]:.12g}"
        raise InputError(wrong)
    return values


def _range(declared: Variable) -> str:
    return f"{declared.low:g} to {declared.high:g}".replace(f"{LARGEST:g}", "inf")


def _require_none(where: str, values: np.ndarray, bad: np.ndarray, what: str) -> None:
    if bad.any():
        first = tuple(np.argwhere(np.atleast_1d(bad))[0].tolist())
        value = values[first] if values.ndim else values
        raise InputError(
            f"{where} contains {what}: {value:g} at {first}, {int(bad.sum())} of {bad.size} in all"
        )


def _checked_value(where: str, value: Any, declared: Variable) -> Any:
    kind, low, high = declared.kind, declared.low, declared.high
    if isinstance(value, np.ndarray | np.generic) and value.size == 1:
        value = value.reshape(()).item()
    if kind == "word" and isinstance(value, int) and not isinstance(value, bool):
        value = str(value)
    if kind in ("text", "word"):
        return _text(where, value, declared)
    # a list of lists of different lengths is not an array
    number = np.asarray(None if isinstance(value, list) else value)
    good = number.ndim == 0 and number.dtype.kind in KINDS[kind][0]
    if good and kind != "boolean" and not (declared.missing and not np.isfinite(number)):
        good = bool(low <= number <= high)
    if not good:
        limits = "" if low == -LARGEST and high == LARGEST else f" from {_range(declared)}"
        words = {"real": "a number", "integer": "a whole number"}.get(kind, KINDS[kind][2])
        raise InputError(f"{where} is {reprlib.repr(value)}, expected {words}{limits}")
    if declared.unit == "MHz":
        require_mhz(where, number)
    return KINDS[kind][1](number).item()


def _text(where: str, value: Any, declared: Variable) -> str:
    with refusing(f"{where} contains text that is not UTF-8: {value!r}", UnicodeDecodeError):
        text = value.decode() if isinstance(value, bytes) else value
    if not isinstance(text, str):
        raise InputError(f"{where} is {value!r}, expected text")
    if declared.choices:
        require_known(f"{where} is", str(text), declared.choices)
    return str(text)
