"""Dataclasses as trees of datasets: what the package writes of its own, and reads again.

The types of the fields say what becomes of them. Arrays (``Float[np.ndarray, "draw mode"]``) are
variables on the dimensions that they name; numbers and text are attributes; None is absent;
dataclasses with arrays are groups, and tuples of dataclasses of numbers and text alone are tables.
Whatever else JSON holds, other dataclasses too, is an attribute in JSON.

Arrays say their unit and what they are with :func:`quantity`, as the CF conventions have it. Those
on one of the dimensions :data:`.HEALPIX` have the grid mapping of HEALPix of CF 1.13: a variable
that names grid and order, and the index of every pixel.

Files are written with xarray, and read with h5py, which takes a tenth of the time.
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
from lusee_bayes.core.formats import header, require_format, with_grid
from lusee_bayes.core.layouts import Attribute, Layout, Unloaded, Unread, Variable
from lusee_bayes.core.lazy import pandas, xarray
from lusee_bayes.core.reading import reading

T = TypeVar("T")
# an attribute that lists arrays without entries, which files do not hold
EMPTY = "empty"
# kinds that are attributes, and numbers by their types
ATTRIBUTES = ("number", "text", "json")
NUMBERS = {int: "integer", float: "real", bool: "boolean"}
# what an array is declared as by the kind of its dtype, and how one that may have any numbers is
KINDS = {"f": "real", "c": "complex", "i": "integer", "u": "integer", "b": "boolean", "U": "text"}
ANY = {"missing": True, "low": -np.inf, "high": np.inf}
# how netCDF marks arrays in HDF5 that stand for a dimension alone
DIMENSION = b"This is a netCDF dimension but not a netCDF variable"


def quantity(
    units: str,
    long_name: str = "",
    *,
    checks: Mapping[str, Any] | None = None,
    attributes: Mapping[str, Any] | None = None,
    packed: bool = False,
    **options: Any,
) -> Any:
    """A field of a dataclass: an array with its unit, as UDUNITS writes it, and what it is.

    Parameters
    ----------
    units : str
        Such as "K" or "MHz"; "1" for numbers without one, empty for text.
    long_name : str
        A few words.
    checks : mapping, optional
        What a file is checked for, as of :class:`.Variable`: ``low``, ``grows`` and others. By
        default there may be any numbers.
    attributes : mapping, optional
        Further ones of CF's, such as ``flag_meanings``.
    packed : bool
        Compress it in files.
    **options
        As of ``dataclasses.field``.
    """
    said = {"units": units, "long_name": long_name}
    attributes = {name: words for name, words in said.items() if words} | dict(attributes or {})
    metadata = {
        "attributes": attributes,
        "checks": ANY if checks is None else checks,
        "encoding": {"zlib": True, "complevel": 1} if packed else {},
    }
    return field(metadata=metadata, **options)


@dataclass(frozen=True)
class _Kind:
    """What becomes of a field.

    what : "array", "number", "text", "json", "group", "table" or "frame"; of : the type of the
    value or of its rows; optional : whether it may be None; required : whether it has no default;
    declared : of an array or an attribute; attributes, encoding : of an array
    """

    what: str
    of: Any = None
    optional: bool = False
    required: bool = True
    declared: Variable | None = None
    attributes: Mapping[str, str] = field(default_factory=dict)
    encoding: Mapping[str, Any] = field(default_factory=dict)


def to_tree(value: Any) -> xarray.DataTree:
    """Lay out a dataclass.

    Parameters
    ----------
    value : dataclass

    Returns
    -------
    xarray.DataTree
    """
    variables, attributes, groups, empty = {}, {}, {}, {}
    for name, kind in _fields(type(value)).items():
        held = getattr(value, name)
        if held is None:
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
        Further ones of the file.
    """
    tree = to_tree(value)
    tree.attrs |= header(format_) | dict(attributes or {})
    with replacing(path) as partial:
        tree.to_netcdf(partial, engine="h5netcdf")
    return user_path(path)


class StoredTree:
    """A group of a netCDF file that is open, with what :func:`from_tree` looks at in a tree.

    Parameters
    ----------
    group : h5py.Group
    """

    def __init__(self, group: h5py.Group):
        self._group = group

    @cached_property
    def attrs(self) -> dict[str, Any]:
        """Attributes, of one entry each as numbers and text."""
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
        """Groups in this one."""
        return {n: StoredTree(x) for n, x in self._group.items() if isinstance(x, h5py.Group)}


def _stored(variable: h5py.Dataset) -> np.ndarray:
    is_text = h5py.check_string_dtype(variable.dtype) is not None
    return (variable.asstr() if is_text else variable)[...]


@contextmanager
def opened_tree(path: str | Path, format_: str, what: str, hint: str = "") -> Iterator[StoredTree]:
    """Open a file of the package; what is not asked for is not read.

    Parameters
    ----------
    path, format_, what, hint
        As of :func:`.require_format`.

    Raises
    ------
    InputError
        If the file is missing, damaged or of another kind.
    """
    path = require_format(path, format_, what, hint)
    with reading(path, what), h5py.File(path) as file:
        yield StoredTree(file)


def from_tree(kind: type[T], tree: xarray.DataTree | StoredTree, where: str) -> T:
    """Make a dataclass of what :func:`to_tree` made of one.

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
        Of this type.

    Raises
    ------
    InputError
        If something is absent, or of another type or another number of dimensions.
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
            entries[name] = content.arrays[name].astype(one.of, copy=False)
        elif name in content.values:
            value = content.values[name]
            entries[name] = _of_json(one.of, value, place) if one.what == "json" else value
        elif name in empty:
            entries[name] = np.zeros([int(n) for n in empty[name]], dtype=one.of)
        elif name in tree.children:
            entries[name] = _of_group(one, tree.children[name], place)
        elif one.optional:
            entries[name] = None
        elif one.required:
            raise InputError(f"{where} has no {name} (it has {', '.join(tree.children)})")
    return kind(**entries)


_checker = lru_cache(maxsize=128)(TypeAdapter)


def _for_json(value: Any) -> Any:
    """What JSON has no words for: dataclasses, NumPy's numbers."""
    return asdict(value) if is_dataclass(value) else value.item()


@lru_cache(maxsize=128)
def _fields(kind: type) -> dict[str, _Kind]:
    hints, by_name = get_type_hints(kind), {}
    for one in fields(kind):
        what = _kind_of(hints[one.name], one.metadata.get("checks", ANY))
        required = not what.optional and one.default is one.default_factory is MISSING
        declared = what.declared and replace(what.declared, optional=not required)
        written = {n: x for n, x in one.metadata.items() if n in ("attributes", "encoding")}
        by_name[one.name] = replace(what, required=required, declared=declared, **written)
    return by_name


def _kind_of(hint: Any, checks: Mapping[str, Any] = ANY) -> _Kind:
    arguments = get_args(hint)
    if get_origin(hint) in (Union, types.UnionType):
        # arrays of NumPy's or of JAX's are one
        others = [one for one in arguments if one is not type(None)]
        return replace(_kind_of(others[0], checks), optional=len(others) < len(arguments))
    if hasattr(hint, "dim_str"):
        names, dtype = hint.dim_str.split(), _dtype(hint.dtypes)
        # a matrix has the same dimension twice, which datasets do not allow
        dims = [n if n not in names[:k] else f"{n}_{k + 1}" for k, n in enumerate(names)]
        return _Kind("array", dtype, declared=Variable(tuple(dims), KINDS[dtype.kind], **checks))
    if get_origin(hint) is tuple and is_dataclass(arguments[0]):
        kinds = _fields(arguments[0]).values()
        if all(k.what == "number" or (k.what == "text" and not k.optional) for k in kinds):
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
    """Columns as variables; one of numbers may have gaps."""
    arrays = {}
    for key, values in columns.items():
        array = np.array([np.nan if value is None else value for value in values])
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
    columns = {}
    for name, one in kinds.items():
        # gaps make whole numbers real
        as_real = {"kind": "real"} if one.optional else {}
        columns[name] = replace(one.declared, dims=("row",), optional=False, **as_real)
    arrays = Layout(kind.__name__, columns).checked(where, tree.variables, {}).arrays
    for row in zip(*(arrays[name].tolist() for name in kinds), strict=True):
        values = zip(kinds.items(), row, strict=True)
        yield kind(**{n: None if k.optional and x != x else k.of(x) for (n, k), x in values})


def _dtype(names: Any) -> np.dtype:
    """The widest that an annotation allows; that of text for Shaped, which has none."""
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
