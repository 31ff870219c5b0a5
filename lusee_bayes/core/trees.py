"""Dataclasses as trees of datasets: the package's own files, written and read.

The type of a field determines how it is stored. Arrays (``Float[np.ndarray, "draw mode"]``) become
variables on the dimensions that they name; numbers and text become attributes; None is omitted.
Dataclasses with arrays become groups, and tuples of dataclasses with only numbers and text become
tables. Anything else in JSON's range, including other dataclasses, becomes a JSON attribute.

:func:`quantity` gives an array its unit and name, following the CF conventions. Arrays on one of
the dimensions :data:`.HEALPIX` have CF 1.13's HEALPix grid mapping: a variable that names grid and
order, and the index of every pixel.

Files are written with xarray and read with h5py, which takes a tenth of the time.
"""

from __future__ import annotations

import json
import types
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import MISSING, asdict, dataclass, field, fields, is_dataclass, replace
from functools import cached_property, lru_cache, partial
from pathlib import Path
from typing import Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

import h5py
import numpy as np
from pydantic import TypeAdapter, ValidationError

from lusee_bayes.core.errors import InputError, refusing
from lusee_bayes.core.files import replacing, user_path
from lusee_bayes.core.formats import header, require_format, with_grid, write_netcdf
from lusee_bayes.core.layouts import Attribute, Layout, Unloaded, Unread, Variable
from lusee_bayes.core.lazy import pandas, xarray
from lusee_bayes.core.reading import reading

T = TypeVar("T")
# an attribute that lists empty arrays, which are not written as variables
EMPTY = "empty"
# kinds stored as attributes, and the kind of number of each type
ATTRIBUTES = ("number", "text", "json")
NUMBERS = {int: "integer", float: "real", bool: "boolean"}
# the declared kind of an array by the kind of its dtype, and the checks that allow any numbers
KINDS = {"f": "real", "c": "complex", "i": "integer", "u": "integer", "b": "boolean", "U": "text"}
ANY = {"missing": True, "low": -np.inf, "high": np.inf}
# netCDF's mark for HDF5 arrays that only stand for a dimension
DIMENSION = b"This is a netCDF dimension but not a netCDF variable"


def quantity(
    units: str,
    long_name: str = "",
    *,
    checks: Mapping[str, Any] | None = None,
    attributes: Mapping[str, Any] | None = None,
    packed: bool = False,
    stored: str | None = None,
    **options: Any,
) -> Any:
    """A dataclass field for an array, with its unit in UDUNITS notation and its description.

    Parameters
    ----------
    units : str
        Such as "K" or "MHz"; "1" for numbers without a unit, empty for text.
    long_name : str
        A few words.
    checks : mapping, optional
        Checks when reading a file, as in :class:`.Variable`: ``low``, ``grows`` and others. By
        default, any numbers are allowed.
    attributes : mapping, optional
        Further CF attributes, such as ``flag_meanings``.
    packed : bool
        Compress the array in files.
    stored : str, optional
        Name in files; by default that of the field.
    **options
        As in ``dataclasses.field``.
    """
    said = {"units": units, "long_name": long_name}
    attributes = {name: words for name, words in said.items() if words} | dict(attributes or {})
    metadata = {
        "attributes": attributes,
        "checks": ANY if checks is None else checks,
        "encoding": {"zlib": True, "complevel": 1} if packed else {},
        "stored": stored,
    }
    return field(metadata=metadata, **options)


@dataclass(frozen=True)
class _Kind:
    """How a field is stored.

    what : "array", "number", "text", "json", "group", "table" or "frame"; of : the type of the
    value or of its rows; optional : whether it may be None; required : whether it has no default;
    declared : layout of an array or attribute; attributes, encoding : for an array; field : name
    """

    what: str
    of: Any = None
    optional: bool = False
    required: bool = True
    declared: Variable | None = None
    attributes: Mapping[str, str] = field(default_factory=dict)
    encoding: Mapping[str, Any] = field(default_factory=dict)
    field: str = ""


def to_tree(value: Any) -> xarray.DataTree:
    """Convert a dataclass to a tree of datasets.

    Parameters
    ----------
    value : dataclass

    Returns
    -------
    xarray.DataTree
    """
    variables, attributes, groups, empty = {}, {}, {}, {}
    for name, kind in _fields(type(value)).items():
        if (held := getattr(value, kind.field)) is None:
            continue
        if kind.what == "array":
            array = np.asarray(held)
            if array.size:
                variables[name] = (kind.declared.dims, array, kind.attributes, kind.encoding)
            else:
                empty[name] = array.shape
        elif kind.what == "group":
            groups[name] = to_tree(held)
        elif kind.what == "table":
            columns = {f.name: [getattr(one, f.name) for one in held] for f in fields(kind.of)}
            groups[name] = _table(name, columns)
        elif kind.what == "frame":
            groups[name] = _table(name, {str(key): list(held[key]) for key in held})
        elif kind.what == "json":
            attributes[name] = json.dumps(held, default=_for_json)
        else:
            attributes[name] = int(held) if isinstance(held, bool) else held
    if empty:
        attributes[EMPTY] = json.dumps(empty)
    return xarray.DataTree(with_grid(xarray.Dataset(variables, attrs=attributes)), children=groups)


def write_tree(
    path: str | Path, value: Any, format_: str, attributes: Mapping[str, Any] | None = None
) -> Path:
    """Write a dataclass as a file of the package, whole or not at all.

    Parameters
    ----------
    path : str or Path
    value : dataclass
    format_ : str
        One of :mod:`.formats`.
    attributes : mapping, optional
        Further attributes of the file.
    """
    tree = to_tree(value)
    tree.attrs |= header(format_) | dict(attributes or {})
    with replacing(path) as partial:
        write_netcdf(tree, partial)
    return user_path(path)


class StoredTree:
    """A group of an open netCDF file, with the parts of a tree that :func:`from_tree` uses.

    Parameters
    ----------
    group : h5py.Group
    """

    def __init__(self, group: h5py.Group):
        self._group = group

    @cached_property
    def attrs(self) -> dict[str, Any]:
        """Attributes; those with one entry as numbers or text."""
        arrays = {name: np.asarray(value) for name, value in self._group.attrs.items()}
        return {name: v.item() if v.size == 1 else v for name, v in arrays.items()}

    @cached_property
    def variables(self) -> dict[str, Unread]:
        """Arrays, not yet read."""
        items = ((name, x) for name, x in self._group.items() if isinstance(x, h5py.Dataset))
        return {
            name: Unloaded(x.shape, x.dtype, partial(_stored, x))
            for name, x in items
            if not (x.is_scale and x.attrs.get("NAME", b"").startswith(DIMENSION))
        }

    @cached_property
    def children(self) -> dict[str, StoredTree]:
        """Groups inside this group."""
        return {n: StoredTree(x) for n, x in self._group.items() if isinstance(x, h5py.Group)}


def _stored(variable: h5py.Dataset) -> np.ndarray:
    is_text = h5py.check_string_dtype(variable.dtype) is not None
    return (variable.asstr() if is_text else variable)[...]


@contextmanager
def opened_tree(path: str | Path, format_: str, what: str, hint: str = "") -> Iterator[StoredTree]:
    """Open a file of the package; arrays are read when used.

    Parameters
    ----------
    path, format_, what, hint
        As in :func:`.require_format`.

    Raises
    ------
    InputError
        If the file is missing, damaged or of another kind.
    """
    path = require_format(path, format_, what, hint)
    with reading(path, what), h5py.File(path) as file:
        yield StoredTree(file)


def from_tree(kind: type[T], tree: xarray.DataTree | StoredTree, where: str) -> T:
    """Rebuild a dataclass from the tree that :func:`to_tree` built.

    Parameters
    ----------
    kind : type
        The dataclass.
    tree : xarray.DataTree or StoredTree
    where : str
        The file, for messages.

    Returns
    -------
    object
        An instance of the dataclass.

    Raises
    ------
    InputError
        If an entry is missing, or has another type or another number of dimensions.
    """
    kinds, entries = _fields(kind), dict[str, Any]()
    empty = _json(where, tree.attrs.get(EMPTY, "{}"))
    said = {n: k for n, k in kinds.items() if k.declared is not None and n not in empty}
    arrays = {name: one.declared for name, one in said.items() if one.what == "array"}
    values = {name: one.declared for name, one in said.items() if one.what != "array"}
    content = Layout(kind.__name__, arrays, values).checked(where, tree.variables, tree.attrs)
    for name, one in kinds.items():
        place = f"{where}: {name}"
        if name in content.arrays:
            entries[one.field] = content.arrays[name].astype(one.of, copy=False)
        elif name in content.values:
            value = content.values[name]
            entries[one.field] = _of_json(one.of, value, place) if one.what == "json" else value
        elif name in empty:
            entries[one.field] = np.zeros([int(n) for n in empty[name]], dtype=one.of)
        elif name in tree.children:
            entries[one.field] = _of_group(one, tree.children[name], place)
        elif one.optional:
            entries[one.field] = None
        elif one.required:
            raise InputError(f"{where} has no {name} (it has {', '.join(tree.children)})")
    return kind(**entries)


_checker = lru_cache(maxsize=128)(TypeAdapter)


def _for_json(value: Any) -> Any:
    """Convert values that JSON lacks: dataclasses and NumPy's numbers."""
    return asdict(value) if is_dataclass(value) else value.item()


@lru_cache(maxsize=128)
def _fields(kind: type) -> dict[str, _Kind]:
    hints, by_name = get_type_hints(kind), {}
    for one in fields(kind):
        what = _kind_of(hints[one.name], one.metadata.get("checks", ANY))
        required = not what.optional and one.default is one.default_factory is MISSING
        declared = what.declared and replace(what.declared, optional=not required)
        written = {n: x for n, x in one.metadata.items() if n in ("attributes", "encoding")}
        written |= {"required": required, "declared": declared, "field": one.name}
        by_name[one.metadata.get("stored") or one.name] = replace(what, **written)
    return by_name


def _kind_of(hint: Any, checks: Mapping[str, Any] = ANY) -> _Kind:
    arguments = get_args(hint)
    if get_origin(hint) in (Union, types.UnionType):
        # a union of NumPy and JAX arrays counts as one type
        others = [one for one in arguments if one is not type(None)]
        return replace(_kind_of(others[0], checks), optional=len(others) < len(arguments))
    if hasattr(hint, "dim_str"):
        names, dtype = hint.dim_str.split(), _dtype(hint.dtypes)
        # rename repeated dimensions, as of a square matrix, which datasets do not allow
        dims = [n if n not in names[:k] else f"{n}_{k + 1}" for k, n in enumerate(names)]
        return _Kind("array", dtype, declared=Variable(tuple(dims), KINDS[dtype.kind], **checks))
    if get_origin(hint) is tuple and is_dataclass(arguments[0]):
        kinds = _fields(arguments[0]).values()
        if all(k.what in ("number", "text") and not k.optional for k in kinds):
            return _Kind("table", arguments[0])
    if is_dataclass(hint) and any(k.what not in ATTRIBUTES for k in _fields(hint).values()):
        return _Kind("group", hint)
    if hint in NUMBERS:
        return _Kind("number", hint, declared=Attribute(NUMBERS[hint], **ANY))
    if getattr(hint, "__name__", "") == "DataFrame":
        return _Kind("frame")
    if hint is str or get_origin(hint) is Literal:
        return _Kind("text", str, declared=Attribute("text"))
    return _Kind("json", hint, declared=Attribute("text"))


def _table(name: str, columns: Mapping[str, list]) -> xarray.DataTree:
    """Store columns as variables."""
    arrays = {}
    for key, values in columns.items():
        array = np.array(values)
        arrays[key] = (f"{name}_row", array.astype(np.int8) if array.dtype == bool else array)
    rows = {} if not columns or not len(next(iter(columns.values()))) else arrays
    return xarray.DataTree(xarray.Dataset(rows, attrs={"columns": json.dumps(list(columns))}))


def _of_group(kind: _Kind, tree: xarray.DataTree | StoredTree, where: str) -> Any:
    if kind.what == "group":
        return from_tree(kind.of, tree, where)
    if kind.what == "table":
        return tuple(_rows(kind.of, tree, where))
    names = _json(where, tree.attrs.get("columns", "[]"))
    return pandas.DataFrame({name: _column(tree, name, where) for name in names})


def _column(tree: xarray.DataTree | StoredTree, name: str, where: str) -> list:
    if name in tree.variables:
        return np.asarray(tree.variables[name]).tolist()
    if tree.variables:
        raise InputError(f"{where} has no column {name} (it has {', '.join(tree.variables)})")
    return []


def _rows(kind: type[T], tree: xarray.DataTree | StoredTree, where: str) -> Iterator[T]:
    if not tree.variables:
        return
    kinds = _fields(kind)
    columns = {name: replace(one.declared, dims=("row",)) for name, one in kinds.items()}
    arrays = Layout(kind.__name__, columns).checked(where, tree.variables, {}).arrays
    for row in zip(*(arrays[name].tolist() for name in kinds), strict=True):
        yield kind(*(one.of(x) for one, x in zip(kinds.values(), row, strict=True)))


def _dtype(names: Any) -> np.dtype:
    """The widest dtype that an annotation allows; for Shaped, which names none, that for text."""
    if not isinstance(names, list | tuple):
        return np.dtype(str)
    widest = [n for n in ("float64", "complex128", "int64", "bool") if n in names]
    return np.dtype((widest or names)[0])


def _of_json(kind: Any, text: str, where: str) -> Any:
    try:
        return _checker(kind).validate_python(_json(where, text))
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        raise InputError(f"{where} is {text!r}: {first['msg']}") from error


def _json(where: str, text: Any) -> Any:
    with refusing(f"{where} is {text!r}, expected JSON", TypeError, ValueError):
        return json.loads(text)
