"""Damage to files, drawn by hypothesis: bytes of any file, and items of HDF5, FITS and JSON."""

import json
import os
import shutil
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from astropy.io import fits
from hypothesis import strategies as st

from lusee_bayes.core.errors import InputError

FRACTION = st.floats(0.0, 1.0)
# words of extensions that say what they hold
OWN = ("TTYPE", "TUNIT", "EXTNAME", "ORDER", "LUSEE", "ATTRJSON", "COLJSON")
VALUES = st.sampled_from(
    [
        *("", "text", "\uff11\uff12", "2027-13-45", "nan", 0, 1, -1, 3, 10**12, 2**63, True, False),
        *(1e300, 1e-300, -2.5, float("nan"), float("inf"), float("-inf")),
    ]
)
FILLS = st.sampled_from([np.nan, np.inf, -1.0, 0.0, 1e30, 1e300, -1e300])


@st.composite
def byte_changes(draw: st.DrawFn) -> tuple[Any, ...]:
    """An operation on the bytes of a file."""
    kind = draw(st.sampled_from(["cut", "flip", "zero", "remove", "insert", "double"]))
    return kind, draw(FRACTION), draw(st.integers(1, 4000)), draw(st.binary(min_size=1, max_size=8))


def change_bytes(path: Path, change: tuple[Any, ...]) -> None:
    """Apply :func:`byte_changes`."""
    kind, fraction, length, data = change
    content = bytearray(path.read_bytes())
    at = int(fraction * max(0, len(content) - 1))
    if kind == "cut":
        del content[at:]
    elif kind == "flip":
        content[at : at + len(data)] = data
    elif kind == "zero":
        content[at : at + length] = bytes(len(content[at : at + length]))
    elif kind == "remove":
        del content[at : at + length]
    elif kind == "insert":
        content[at:at] = data
    else:
        content += content[:at]
    path.write_bytes(bytes(content))


@st.composite
def item_changes(draw: st.DrawFn) -> tuple[Any, ...]:
    """An operation on one item of a file."""
    kinds = ["delete", "rename", "value", "attribute", "drop attribute", "dtype", "shape", "fill"]
    kind = draw(st.sampled_from(kinds))
    return kind, draw(FRACTION), draw(VALUES), draw(FILLS), draw(st.integers(0, 5))


def _at(items: list[Any], fraction: float) -> Any:
    return items[int(fraction * (len(items) - 1))]


def _changed(array: np.ndarray, change: tuple[Any, ...]) -> np.ndarray:
    """Another array in an array's place."""
    kind, _, value, fill, number = change
    with np.errstate(all="ignore"), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        if kind == "fill" and array.dtype.kind in "fiuc" and array.size:
            changed = np.array(array, dtype=float if array.dtype.kind in "iu" else array.dtype)
            flat = changed.reshape(-1)
            flat[: max(1, flat.size >> number)] = fill
            return changed
        if kind == "shape" and array.ndim:
            options = [array.T, array[..., None], array.reshape(-1), array[:0], array[..., :1]]
            return [*options, np.concatenate([array, array])][number % 6]
        if kind == "shape":
            return np.asarray([value])
        if kind == "dtype" and array.dtype.kind in "fiuc":
            types = ["S4", "f4", "i4", "i1", "c16", "?"]
            return (array.real if array.dtype.kind == "c" else array).astype(types[number])
    return np.asarray(value)


def change_hdf5(path: Path, change: tuple[Any, ...]) -> None:
    """Apply :func:`item_changes` to an HDF5 file, netCDF among them."""
    kind, fraction, value, _, number = change
    with h5py.File(path, "r+") as file:
        found: list[Any] = []
        file.visititems(lambda _, item: found.append(item))
        if kind in ("attribute", "drop attribute"):
            owner = file if number < 3 else _at([file, *found], fraction)
            if names := sorted(owner.attrs):
                name = _at(names, fraction)
                del owner.attrs[name]
                if kind == "attribute" and value != 2**63:  # NumPy has no integer for it
                    owner.attrs[name] = value
            return
        items = [item for item in found if isinstance(item, h5py.Dataset)]
        item = _at(items, fraction) if items else None
        name = item and item.name
        if item is not None and kind == "delete":
            del file[name]
        elif item is not None and kind == "rename":
            file.move(name, f"{name}_other")
        elif item is not None:
            array = _changed(np.asarray(item[()]), change)
            if array.dtype.kind == "U":
                array = np.char.encode(array, "utf-8")
            attributes = {k: v for k, v in item.attrs.items() if not k.isupper()}
            del file[name]
            if array.dtype.kind != "O":
                file[name] = array
                for key, kept in attributes.items():
                    if not key.startswith("_Netcdf"):
                        file[name].attrs[key] = kept


def change_fits(path: Path, change: tuple[Any, ...]) -> None:
    """Apply :func:`item_changes` to a FITS file."""
    kind, fraction, value, _, number = change
    with warnings.catch_warnings(), fits.open(path) as opened:
        warnings.simplefilter("ignore")
        hdus = fits.HDUList([hdu.copy() for hdu in opened])
        place = int(fraction * (len(hdus) - 1))
        hdu = hdus[place]
        if kind == "delete" and len(hdus) > 1:
            del hdus[max(1, place)]
        elif kind == "rename":
            hdu.name = "OTHER"
        elif kind in ("attribute", "drop attribute", "value"):
            own = [k for k in hdus[0].header if not k.startswith(("SIMPLE", "BITPIX", "NAXIS"))]
            own += [k for k in hdu.header if k.startswith(OWN)]
            if own:
                key = own[int(fraction * 997) % len(own)]
                owner = hdus[0] if key in hdus[0].header else hdu
                del owner.header[key]
                finite = not isinstance(value, float) or np.isfinite(value)
                if kind != "drop attribute" and finite and str(value).isascii():
                    owner.header[key if len(key) <= 8 else f"HIERARCH {key}"] = value
        elif isinstance(hdu, fits.BinTableHDU):
            names = hdu.columns.names
            if kind == "shape":
                hdus[place] = fits.BinTableHDU(hdu.data[: len(hdu.data) >> 1], hdu.header)
            elif names:
                column = hdu.data[names[number % len(names)]]
                if column.dtype.kind == "f":
                    column[...] = change[3]
        elif hdu.data is not None:
            array = _changed(np.asarray(hdu.data), change)
            if array.dtype.kind in "fiu" and array.ndim:
                if array.dtype.byteorder not in ("=", "|"):
                    array = array.astype(array.dtype.newbyteorder("="))
                hdu.data = np.ascontiguousarray(array)
        scratch = path.with_suffix(".scratch")
        hdus.writeto(scratch, overwrite=True, output_verify="ignore")
    shutil.move(scratch, path)


def change_json(path: Path, change: tuple[Any, ...]) -> None:
    """Apply :func:`item_changes` to a JSON file."""
    kind, fraction, value, _, number = change
    tree = json.loads(path.read_text())
    node: Any = tree
    for _ in range(number % 3):
        children = list(node.values()) if isinstance(node, dict) else list(node)
        inner = [child for child in children if isinstance(child, dict | list) and child]
        if not inner:
            break
        node = _at(inner, fraction)
    keys = list(node) if isinstance(node, dict) else list(range(len(node)))
    if not keys:
        return
    key = _at(keys, fraction)
    if kind == "delete":
        del node[key]
    elif kind == "shape":
        node[key] = [node[key]]
    else:
        node[key] = value
    path.write_text(json.dumps(tree))


CHANGE = dict.fromkeys((".nc", ".hdf5", ".h5"), change_hdf5)
CHANGE |= {".fits": change_fits, ".json": change_json}


def change_items(path: Path, change: tuple[Any, ...]) -> None:
    """Apply :func:`item_changes`, to whatever the file is."""
    CHANGE[path.suffix](path, change)


# how many times as many inputs the long run tries
SCALE = int(os.environ.get("LUSEE_BAYES_FUZZ", "1"))


def require_answer(call: Callable[[], object]) -> None:
    """Assert that a call succeeds, or says in one sentence why it cannot; anything else fails."""
    try:
        call()
    except InputError as error:
        message = str(error)
        assert message and "\n" not in message, repr(message)
        # sentences are read by people
        assert len(message) < 1500, message
