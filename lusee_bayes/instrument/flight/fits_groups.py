"""Groups, arrays and attributes in FITS, as ``lusee.ingest`` has them for layout 4 (``FITSFMT`` 1).

Every group is an extension, ``L4G0001`` and on, with its path (``LUSEEPTH``) and its attributes
(``ATTRJSON``). Its arrays are the columns of a binary table, whose ``COLJSON`` says what FITS
cannot: their shapes and types, attributes, and how they are stored. Arrays of other lengths are in
further tables, which follow (``LUSEEKND`` table-part).
"""

from __future__ import annotations

import base64
import json
import math
import os
import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from astropy.io import fits
from jaxtyping import Shaped

from lusee_bayes.core.errors import InputError

FORMAT = 1
# how FITS stores what its letters stand for
STORED = {
    "L": "u1",
    "B": "u1",
    "I": ">i2",
    "J": ">i4",
    "K": ">i8",
    "E": ">f4",
    "D": ">f8",
    "C": ">c8",
    "M": ">c16",
}
TFORM = re.compile(r"(\d*)([A-Z])")
TRUE = ord("T")
# what a computer reads at least
PAGE = 4096


@dataclass(frozen=True)
class Column:
    """An array that is a column of a table, read when it is asked for.

    Attributes
    ----------
    path : Path
    start : int
        Where the table begins in the file, in bytes.
    stride : int
        Bytes from row to row.
    offset : int
        Bytes from the beginning of a row to this column.
    stored : dtype
        Of a cell, as it is stored; with its length.
    shape : tuple of int
        Of the array.
    dtype : dtype
        Of the array.
    encoding : str
        How it is stored.
    attributes : mapping of str to object
    """

    path: Path
    start: int
    stride: int
    offset: int
    stored: np.dtype
    shape: tuple[int, ...]
    dtype: np.dtype
    encoding: str
    attributes: Mapping[str, Any]

    def rows(self, first: int, last: int) -> Shaped[np.ndarray, "_ ..."]:
        """Return rows [first:last] of the array.

        Raises
        ------
        ValueError
            If the file is too short, or holds texts that are none.
        """
        shape = (len(range(*slice(first, last).indices(self.shape[0]))), *self.shape[1:])
        if 0 in shape:
            return np.empty(shape, dtype=self.dtype)
        return self._decoded(self._cells(first, first + shape[0])).reshape(shape)

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> np.ndarray:
        whole = self.rows(0, self.shape[0])
        return whole if dtype is None else whole.astype(dtype)

    def _cells(self, first: int, last: int) -> np.ndarray:
        size = self.stored.itemsize
        with self.path.open("rb", buffering=0) as file:
            if self.start + self.shape[0] * self.stride > os.fstat(file.fileno()).st_size:
                raise ValueError("a table ends behind the end of the file")
            if self.stride > PAGE and 2 * size < self.stride:
                # next to spectra: these are not read
                start = self.start + self.offset
                places = (start + row * self.stride for row in range(first, last))
                parts = b"".join(os.pread(file.fileno(), size, place) for place in places)
                return np.frombuffer(parts, self.stored).copy()
            row = {"names": ["cell"], "formats": [self.stored], "offsets": [self.offset]}
            file.seek(self.start + first * self.stride)
            rows = np.fromfile(file, np.dtype(row | {"itemsize": self.stride}), last - first)
            return np.ascontiguousarray(rows["cell"])

    def _decoded(self, cells: np.ndarray) -> np.ndarray:
        if self.encoding == "utf8":
            bytes_ = cells.view(f"S{cells.size // math.prod((len(cells), *self.shape[1:]))}")
            return np.char.decode(bytes_, "utf-8")
        if self.encoding == "bytes":
            return cells.view(self.dtype)
        if self.dtype.kind == "b":
            return cells == TRUE
        if self.encoding == "unsigned" and self.dtype.itemsize > 1:
            # stored less half of their range: the uppermost bit is the other one
            half = self.dtype.type(1 << (8 * self.dtype.itemsize - 1))
            return cells.astype(cells.dtype.newbyteorder("=")).view(self.dtype) ^ half
        return cells.astype(self.dtype)


class FITSGroups:
    """Groups and arrays of an open FITS file, by their paths: a :class:`.Tree`.

    Parameters
    ----------
    path : Path
    hdus : HDUList

    Raises
    ------
    InputError
        If it has another version of this transport, or extensions are missing or not in order.
    """

    def __init__(self, path: Path, hdus: fits.HDUList):
        self._path = path
        self._attributes: dict[str, Mapping[str, Any]] = {}
        self._tables: dict[str, _Table] = {}
        version = hdus[0].header.get("FITSFMT")
        if version != FORMAT:
            raise InputError(
                f"{path}: FITSFMT is {version}; this version reads {FORMAT} of layout 4 in FITS; "
                "get a newer one"
            )
        for number, hdu in enumerate(hdus):
            self._add(number, hdu)

    def attributes(self, path: str) -> Mapping[str, Any]:
        """Return what a group or an array says of itself; nothing where there is none."""
        if path in self._attributes:
            return self._attributes[path]
        column = self.array(path)
        return {} if column is None else column.attributes

    def array(self, path: str) -> Column | None:
        """Return an array, not yet read, or None.

        Raises
        ------
        InputError
            If the table has it in another form than it says.
        """
        table = self._tables.get(path)
        return None if table is None else table.column(path.rpartition("/")[2])

    def names(self, path: str) -> list[str]:
        """Return the names of all groups and arrays of a group; "" is the whole file."""
        start = f"{path}/" if path else ""
        paths = [*self._attributes, *self._tables]
        below = (one[len(start) :] for one in paths if one and one.startswith(start))
        return list(dict.fromkeys(name.split("/")[0] for name in below))

    def _add(self, number: int, hdu: Any) -> None:
        where = f"{self._path}: extension {number} ({hdu.name})"
        if number and hdu.name != f"L4G{number:04d}":
            raise InputError(
                f"{where} should be L4G{number:04d}: one is missing, or it is no session of "
                "luseepy's lusee.ingest; write the file again with luseepy"
            )
        header = hdu.header
        kind, group = header["LUSEEKND"], header["LUSEEPTH"].strip("/")
        if kind != "table-part":
            if group in self._attributes:
                raise InputError(f"{where} has the path of another one, /{group}")
            said = json.loads(header["ATTRJSON"])
            self._attributes[group] = {key: _attribute(one) for key, one in said.items()}
        if kind in ("table", "table-part"):
            table = _Table(self._path, where, header, hdu.fileinfo()["datLoc"])
            for name in table.said:
                if f"{group}/{name}" in self._tables:
                    raise InputError(f"{where} has /{group}/{name} once more")
                self._tables[f"{group}/{name}"] = table
        elif kind not in ("primary", "group"):
            raise InputError(f"{where} is of the kind '{kind}', which layout 4 does not have")


@dataclass(frozen=True)
class _Table:
    path: Path
    where: str
    header: fits.Header
    start: int

    @cached_property
    def said(self) -> dict[str, Any]:
        """What COLJSON says of each array."""
        return json.loads(self.header["COLJSON"])

    @cached_property
    def places(self) -> dict[str, tuple[int, int, np.dtype]]:
        """The number, the offset and the type of each column."""
        found, offset = {}, 0
        for number in range(1, self.header["TFIELDS"] + 1):
            match = TFORM.fullmatch(self.header[f"TFORM{number}"].strip())
            if match is None or match[2] not in STORED:
                raise InputError(f"{self.where}: TFORM{number} is no format of layout 4")
            stored = np.dtype((STORED[match[2]], (int(match[1] or 1),)))
            found[self.header[f"TTYPE{number}"].strip()] = number, offset, stored
            offset += stored.itemsize
        if offset != (length := self.header["NAXIS1"]):
            raise InputError(f"{self.where}: its rows have {length} bytes, its columns {offset}")
        return found

    def column(self, name: str) -> Column:
        said = self.said[name]
        stored_as = said.get("transport_name", name)
        if stored_as not in self.places:
            raise InputError(f"{self.where} has no column {stored_as}, which COLJSON lists")
        number, offset, stored = self.places[stored_as]
        shape, encoding = tuple(map(int, said["logical_shape"])), said["encoding"]
        text = said["logical_dtype"] == "utf8"
        dtype = np.dtype(np.str_ if text else said["logical_dtype"])
        letter = self.header[f"TFORM{number}"].strip()[-1]
        half = None
        if encoding == "unsigned" and dtype.itemsize > 1:
            half = 1 << (8 * dtype.itemsize - 1)
        length = math.prod(shape[1:]) * {"utf8": said.get("utf8_width", 1)}.get(
            encoding, dtype.itemsize if encoding == "bytes" else 1
        )
        fits_in = (
            shape[:1] == (self.header["NAXIS2"],)
            and (length == stored.shape[0] or (encoding == "empty" and length == 0))
            and letter in _letters(encoding, dtype)
            and self.header.get(f"TZERO{number}") == half
            and self.header.get(f"TSCAL{number}", 1) == 1
        )
        if not fits_in:
            raise InputError(
                f"{self.where}: column {stored_as} is not what COLJSON says of it: {encoding}, "
                f"{said['logical_dtype']}, shape {shape}"
            )
        return Column(
            path=self.path,
            start=self.start,
            stride=self.header["NAXIS1"],
            offset=offset,
            stored=stored,
            shape=shape,
            dtype=dtype,
            encoding=encoding,
            attributes={key: _attribute(one) for key, one in said["attrs"].items()},
        )


def _letters(encoding: str, dtype: np.dtype) -> str:
    """The letters of FITS that a type may have in an encoding."""
    if encoding in ("empty", "utf8", "bytes"):
        return "B"
    if encoding == "int8":
        return "I" if dtype == np.int8 else ""
    if encoding == "native" and dtype.kind == "b":
        return "L"
    kinds = {"native": "ifc", "unsigned": "u"}.get(encoding, "")
    if dtype.kind not in kinds:
        return ""
    kind = "i" if dtype.kind == "u" and dtype.itemsize > 1 else dtype.kind
    name = f"{kind}{dtype.itemsize}"
    return "".join(k for k, v in STORED.items() if v.lstrip(">") == name and k != "L")


def _attribute(said: Mapping[str, Any]) -> Any:
    if said["encoding"] == "utf8":
        return said["value"]
    if said["encoding"] == "utf8_array":
        return np.array(said["values"], dtype=said["dtype"]).reshape(said["shape"])
    if said["encoding"] != "raw":
        raise ValueError(f"attributes are encoded as {said['encoding']}")
    values = np.frombuffer(base64.b64decode(said["data"], validate=True), dtype=said["dtype"])
    return values.reshape(said["shape"])[()]
