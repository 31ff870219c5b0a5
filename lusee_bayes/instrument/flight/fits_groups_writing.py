"""Write groups, arrays and attributes as FITS, the way of :mod:`.fits_groups`."""

from __future__ import annotations

import base64
import json
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, BinaryIO

import numpy as np
from astropy.io import fits
from jaxtyping import Shaped

from lusee_bayes.instrument.flight.fits_groups import FORMAT, STORED, TRUE
from lusee_bayes.instrument.flight.session_content_4 import Group

# files of FITS are made of records of this length
RECORD = 2880
# kinds and sizes of numbers, as FITS stores them and the letters it has for them
LETTERS = {stored.lstrip(">"): letter for letter, stored in STORED.items() if letter != "L"}


@dataclass(frozen=True, eq=False)
class Late:
    """An array that is written piece by piece: the others of its table have its length.

    Attributes
    ----------
    name : str
    like : array
        Without rows, of the array's shape and type.
    blocks : iterable of (int, array)
        The first row of each piece, and the piece.
    attributes : mapping of str to object
    """

    name: str
    like: np.ndarray
    blocks: Iterable[tuple[int, Shaped[np.ndarray, "_ ..."]]]
    attributes: Mapping[str, Any] = field(default_factory=dict)


def write_groups(
    file: BinaryIO, groups: Mapping[str, Group], late: Mapping[str, Late], primary: Mapping
) -> None:
    """Write all groups, in the order of their paths.

    Parameters
    ----------
    file : binary file
    groups : mapping of str to Group
        By their paths; "" is the whole file and comes first.
    late : mapping of str to Late
        Arrays of groups, by the paths of these.
    primary : mapping of str to object
        Further words of the primary header.
    """
    header = fits.PrimaryHDU().header
    header.update({**primary, "FITSFMT": FORMAT, "LUSEEPTH": "/", "LUSEEKND": "primary"})
    header["ATTRJSON"] = _json(_attributes(groups[""].attributes))
    _write_header(file, header)
    number = 1
    for path in sorted(path for path in groups if path):
        number += _write_group(file, number, path, groups[path], late.get(path))


def _write_group(file: BinaryIO, number: int, path: str, group: Group, late: Late | None) -> int:
    """Write a group, and return how many extensions it takes."""
    lengths = sorted({len(values) for values in group.arrays.values()})
    said = {"LUSEEPTH": f"/{path}", "ATTRJSON": _json(_attributes(group.attributes))}
    if len(lengths) == 1:
        _write_table(file, number, {**said, "LUSEEKND": "table"}, group.arrays, late)
        return 1
    header = fits.ImageHDU(name=f"L4G{number:04d}").header
    header.update({**said, "LUSEEKND": "group"})
    _write_header(file, header)
    for part, n in enumerate(lengths):
        arrays = {name: values for name, values in group.arrays.items() if len(values) == n}
        said = {"LUSEEPTH": f"/{path}", "LUSEEKND": "table-part", "LUSEEPRT": part}
        _write_table(file, number + 1 + part, said, arrays, late)
    return 1 + len(lengths)


def _write_table(
    file: BinaryIO,
    number: int,
    said: Mapping[str, Any],
    arrays: Mapping[str, np.ndarray],
    late: Late | None,
) -> None:
    n = len(next(iter(arrays.values())))
    stored = {name: _stored(values, values.shape) for name, values in arrays.items()}
    if late is not None:
        stored[late.name] = _stored(late.like, (n, *late.like.shape[1:]), late.attributes)
    stored = dict(sorted(stored.items()))
    row = np.dtype([(name, cells.dtype, cells.shape[1:]) for name, (cells, _) in stored.items()])
    header = fits.Header()
    header.update({"XTENSION": "BINTABLE", "BITPIX": 8, "NAXIS": 2, "NAXIS1": row.itemsize})
    header.update({"NAXIS2": n, "PCOUNT": 0, "GCOUNT": 1, "TFIELDS": len(stored)})
    for place, (name, (cells, schema)) in enumerate(stored.items(), start=1):
        header[f"TTYPE{place}"] = name
        header[f"TFORM{place}"] = schema["tform"]
        if cells.ndim > 1:
            header[f"TDIM{place}"] = f"({','.join(map(str, reversed(cells.shape[1:])))})"
        if schema.get("bzero") is not None:
            header[f"TZERO{place}"] = schema["bzero"]
    header["EXTNAME"] = f"L4G{number:04d}"
    header.update(said)
    header["COLJSON"] = _json({name: schema for name, (_, schema) in stored.items()})
    _write_header(file, header)
    size = 0
    for first, last, block in _pieces(n, late):
        table = np.zeros(last - first, dtype=row)
        for name in arrays:
            table[name] = stored[name][0][first:last]
        if block is not None:
            table[late.name] = block
        size += file.write(table.tobytes())
    file.write(b"\0" * (-size % RECORD))


def _pieces(n: int, late: Late | None) -> Iterator[tuple[int, int, np.ndarray | None]]:
    """Rows from and to which a table is written at once, and the piece of the late array."""
    if late is None:
        yield 0, n, None
        return
    for first, block in late.blocks:
        yield first, first + len(block), block


def _stored(
    values: np.ndarray, shape: tuple[int, ...], attributes: Mapping[str, Any] | None = None
) -> tuple[np.ndarray, dict[str, Any]]:
    """An array as FITS stores it, and what COLJSON says of it."""
    dtype, said = values.dtype, {"encoding": "native"}
    name = dtype.str
    if dtype.kind == "U":
        name, encoded = "utf8", np.char.encode(values, "utf-8")
        width = encoded.dtype.itemsize
        cells = encoded.view(np.uint8).reshape(*values.shape, width)
        letter, said = "B", {"encoding": "utf8", "utf8_width": width}
    elif dtype.kind == "b":
        letter, cells = "L", np.where(values, TRUE, ord("F")).astype(np.uint8)
    elif dtype.kind == "u":
        half = 1 << (8 * dtype.itemsize - 1)
        said = {"encoding": "unsigned", "bzero": half if dtype.itemsize > 1 else None}
        if dtype.itemsize == 1:
            letter, cells = "B", values
        else:
            signed = f"i{dtype.itemsize}"
            letter, cells = LETTERS[signed], (values ^ dtype.type(half)).view(signed)
    else:
        letter, cells = LETTERS[f"{dtype.kind}{dtype.itemsize}"], values
    length = int(np.prod(cells.shape[1:], dtype=np.int64))
    said["tform"] = letter if length == 1 else f"{length}{letter}"
    said |= {"logical_dtype": name, "logical_shape": list(shape)}
    said["attrs"] = _attributes(attributes or {})
    return cells.astype(STORED[letter]), said


def _attributes(attributes: Mapping[str, Any]) -> dict[str, Any]:
    return {name: _attribute(value) for name, value in attributes.items()}


def _attribute(value: Any) -> dict[str, Any]:
    if isinstance(value, str):
        return {"encoding": "utf8", "value": value}
    array = np.asarray(value)
    return {
        "encoding": "raw",
        "dtype": array.dtype.str,
        "shape": list(array.shape),
        "data": base64.b64encode(array.tobytes()).decode("ascii"),
    }


def _json(value: object) -> str:
    return json.dumps(value, sort_keys=True, separators=(",", ":"), allow_nan=False)


def _write_header(file: BinaryIO, header: fits.Header) -> None:
    file.write(header.tostring().encode("ascii"))
