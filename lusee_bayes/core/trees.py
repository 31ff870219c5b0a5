"""Dataclasses as trees of datasets: what the package writes of its own, and reads again.

The types of the fields say what becomes of them. Arrays (``Float[np.ndarray, "draw mode"]``) are
variables on the dimensions that they name; numbers and text are attributes; None is absent;
dataclasses with arrays are groups, and tuples of dataclasses of numbers and text alone are tables.
Whatever else JSON holds, other dataclasses too, is an attribute in JSON.

Arrays say their unit and what they are with :func:`quantity`, as the CF conventions have it. Those
on one of the dimensions :data:`HEALPIX` have the grid mapping of HEALPix of CF 1.13: a variable that
names grid and order, and the index of every pixel.

Files are written with xarray, and read with h5py, which takes a tenth of the time.
"""

from __future__ import annotations

import json
import types
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import MISSING, Field, asdict, dataclass, field, fields, is_dataclass
from functools import cached_property, lru_cache, partial
from pathlib import Path
from typing import Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

import h5py
import numpy as np
from pydantic import TypeAdapter, ValidationError

from lusee_bayes.core.errors import InputError
from lusee_bayes.core.formats import require_format
from lusee_bayes.core.layouts import Unloaded, Unread
from lusee_bayes.core.lazy import pandas as pd
from lusee_bayes.core.lazy import xarray as xr
from lusee_bayes.core.reading import reading

T = TypeVar("T")
# an attribute that lists arrays without entries, which files do not hold
EMPTY = "empty"
# kinds that are attributes
ATTRIBUTES = ("number", "text", "json")
CONVENTIONS = "CF-1.13"
# dimensions that are the pixels of a HEALPix map in RING order
HEALPIX = ("pixel", "pixels", "region")


def quantity(units: str, long_name: str = "", **options: Any) -> Any:
    """A field of a dataclass: an array with its unit, as UDUNITS writes it, and what it is.

    Parameters
    ----------
    units : str
        Such as "K" or "MHz"; "1" for numbers without one.
    long_name : str
        A few words.
    **options
        As of ``dataclasses.field``.
    """
    attributes = {"units": units} | ({"long_name": long_name} if long_name else {})
    return field(metadata={"attributes": attributes}, **options)


@dataclass(frozen=True)
class _Kind:
    """What becomes of a field.

    what : "array", "number", "text", "json", "group", "table" or "frame"; of : the type
    of the value or of its rows; dims : of an array; optional : whether it may be None
    """

    what: str
    of: Any = None
    dims: tuple[str, ...] = ()
    optional: bool = False


def to_tree(value: Any) -> xr.DataTree:
    """Lay out a dataclass.

    Parameters
    ----------
    value : dataclass

    Returns
    -------
    xarray.DataTree
    """
    variables, attributes, groups, empty = {}, {}, {}, {}
    for name, kind, said in _fields(type(value)):
        held = getattr(value, name)
        if held is None:
            continue
        if kind.what == "array":
            array = np.asarray(held)
            if array.size:
                variables[name] = (kind.dims, array, said.metadata.get("attributes", {}))
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
    return xr.DataTree(with_grid(xr.Dataset(variables, attrs=attributes)), children=groups)


def with_grid(dataset: xr.Dataset) -> xr.Dataset:
    """The same with the grid of all arrays in pixels, of whole maps, as CF 1.13 has it."""
    for dim in {*HEALPIX} & {*dataset.dims}:
        n = dataset.sizes[dim]
        grid, index = f"{dim}_grid", f"{dim}_index"
        for variable in dataset.variables.values():
            if dim in variable.dims:
                variable.attrs["grid_mapping"] = grid
        mapping = {
            "grid_mapping_name": "healpix",
            "indexing_scheme": "ring",
            "refinement_level": round(np.log2(n / 12) / 2),
        }
        indices = {"standard_name": "healpix_index", "units": "1"}
        packed = {"zlib": True, "shuffle": True}
        dataset = dataset.assign_coords(
            {index: (dim, np.arange(n, dtype=np.int32), indices, packed)}
        ).assign({grid: ((), np.int8(0), mapping)})
    return dataset


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
        found = {name: np.asarray(value) for name, value in self._group.attrs.items()}
        return {name: v.item() if v.size == 1 else v for name, v in found.items()}

    @cached_property
    def variables(self) -> dict[str, Unread]:
        """Arrays, not yet read."""
        items = ((name, x) for name, x in self._group.items() if isinstance(x, h5py.Dataset))
        return {name: Unloaded(x.shape, x.dtype, partial(_stored, x)) for name, x in items}

    @cached_property
    def children(self) -> dict[str, StoredTree]:
        """Groups in this one."""
        items = ((name, x) for name, x in self._group.items() if isinstance(x, h5py.Group))
        return {name: StoredTree(group) for name, group in items}


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


def from_tree(kind: type[T], tree: xr.DataTree | StoredTree, where: str) -> T:
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
    found, sizes = {}, dict[str, int]()
    empty = _json(where, tree.attrs.get(EMPTY, "{}"))
    for name, kind_of, said in _fields(kind):
        place = f"{where}: {name}"
        if kind_of.what in ("group", "table", "frame"):
            if name in tree.children:
                found[name] = _of_group(kind_of, tree.children[name], place)
        elif kind_of.what == "array":
            if name in tree.variables:
                found[name] = _array(kind_of, tree.variables[name], place, sizes)
            elif name in empty:
                found[name] = np.zeros([int(n) for n in empty[name]], dtype=_dtype(kind_of.of))
        elif name in tree.attrs:
            found[name] = _value(kind_of, tree.attrs[name], place)
        if name in found:
            continue
        if kind_of.optional:
            found[name] = None
        elif said.default is MISSING and said.default_factory is MISSING:
            there = [*tree.variables, *tree.attrs, *tree.children]
            raise InputError(f"{where} has no {name} (it has {', '.join(map(str, there))})")
    return kind(**found)


@lru_cache(maxsize=128)
def _checker(kind: Any) -> TypeAdapter:
    return TypeAdapter(kind)


def _for_json(value: Any) -> Any:
    """What JSON has no words for: dataclasses, NumPy's numbers."""
    return asdict(value) if is_dataclass(value) else value.item()


@lru_cache(maxsize=128)
def _fields(kind: type) -> tuple[tuple[str, _Kind, Field], ...]:
    hints = get_type_hints(kind)
    return tuple((one.name, _kind_of(hints[one.name]), one) for one in fields(kind))


def _kind_of(hint: Any) -> _Kind:
    arguments, optional = get_args(hint), False
    if get_origin(hint) in (Union, types.UnionType):
        # arrays of NumPy's or of JAX's are one
        others = [one for one in arguments if one is not type(None)]
        optional = len(others) < len(arguments)
        found = _kind_of(others[0])
        return _Kind(found.what, found.of, found.dims, optional)
    if hasattr(hint, "dim_str"):
        names = hint.dim_str.split()
        # a matrix has the same dimension twice, which datasets do not allow
        dims = [n if n not in names[:k] else f"{n}_{k + 1}" for k, n in enumerate(names)]
        return _Kind("array", hint.dtypes, tuple(dims))
    if get_origin(hint) is tuple and is_dataclass(arguments[0]):
        kinds = [k for _, k, _ in _fields(arguments[0])]
        if all(k.what == "number" or (k.what == "text" and not k.optional) for k in kinds):
            return _Kind("table", arguments[0])
    if is_dataclass(hint) and any(k.what not in ATTRIBUTES for _, k, _ in _fields(hint)):
        return _Kind("group", hint)
    if hint in (int, float, bool):
        return _Kind("number", hint)
    if hint is str or get_origin(hint) is Literal:
        return _Kind("text", str)
    if getattr(hint, "__name__", "") == "DataFrame":
        return _Kind("frame")
    return _Kind("json", hint)


def _table(name: str, columns: Mapping[str, list]) -> xr.DataTree:
    """Columns as variables; one of numbers may have gaps."""
    found = {}
    for key, values in columns.items():
        array = np.array([np.nan if value is None else value for value in values])
        found[key] = (f"{name}_row", array.astype(np.int8) if array.dtype == bool else array)
    attributes = {"columns": json.dumps(list(columns))}
    rows = {} if not columns or not len(next(iter(columns.values()))) else found
    return xr.DataTree(xr.Dataset(rows, attrs=attributes))


def _of_group(kind: _Kind, tree: xr.DataTree | StoredTree, where: str) -> Any:
    if kind.what == "group":
        return from_tree(kind.of, tree, where)
    if kind.what == "frame":
        names = _json(where, tree.attrs.get("columns", "[]"))
        return pd.DataFrame({name: _column(tree, name, where) for name in names})
    columns = {
        name: [_value(k, value, f"{where}.{name}") for value in _column(tree, name, where)]
        for name, k, _ in _fields(kind.of)
    }
    return tuple(
        kind.of(**dict(zip(columns, row, strict=True)))
        for row in zip(*columns.values(), strict=True)
    )


def _column(tree: xr.DataTree | StoredTree, name: str, where: str) -> list:
    if name in tree.variables:
        return np.asarray(tree.variables[name]).tolist()
    if tree.variables:
        raise InputError(f"{where} has no column {name} (it has {', '.join(tree.variables)})")
    return []


def _array(kind: _Kind, variable: Unread, where: str, sizes: dict[str, int]) -> np.ndarray:
    if len(variable.shape) != len(kind.dims):
        raise InputError(
            f"{where} has {len(variable.shape)} dimensions, expected {len(kind.dims)}"
            f" ({', '.join(kind.dims) or 'none'})"
        )
    for dim, n in zip(kind.dims, variable.shape, strict=True):
        if sizes.setdefault(dim, n) != n:
            raise InputError(f"{where} has {n} {dim}, other arrays of its group {sizes[dim]}")
    wanted = _dtype(kind.of)
    # files hold no true and false, but whole numbers
    as_bool = wanted == bool and variable.dtype.kind in "iu"
    if not as_bool and not np.can_cast(variable.dtype, wanted, casting="same_kind"):
        raise InputError(f"{where} holds values of type {variable.dtype}, expected {wanted}")
    return np.asarray(variable).astype(wanted, copy=False)


def _dtype(names: Any) -> np.dtype:
    """The widest that an annotation allows."""
    for name in ("float64", "complex128", "int64", "bool", *(names if names is not Any else ())):
        if name in names:
            return np.dtype(name)
    raise TypeError(f"no dtype of NumPy among {names}")


def _value(kind: _Kind, value: Any, where: str) -> Any:
    value = value.item() if isinstance(value, np.generic) else value
    if kind.what == "json":
        try:
            return _checker(kind.of).validate_python(_json(where, value))
        except ValidationError as error:
            first = error.errors(include_url=False)[0]
            raise InputError(f"{where} is {value!r}: {first['msg']}") from error
    good = isinstance(value, str) if kind.what == "text" else isinstance(value, int | float)
    if kind.what == "number" and kind.optional and good and np.isnan(value):
        return None
    if not good or (kind.of is int and not float(value).is_integer()):
        expected = {str: "text", int: "a whole number"}.get(kind.of, "a number")
        raise InputError(f"{where} is {value!r}, expected {expected}")
    return kind.of(value)


def _json(where: str, text: Any) -> Any:
    try:
        return json.loads(text)
    except (TypeError, ValueError) as error:
        raise InputError(f"{where} is {text!r}, expected JSON") from error
