"""HDF5, netCDF and FITS files, read by their declared layouts.

Every file of the package says which of its formats it has, in ``format``. On damaged metadata
HDF5's library may run for ever, or end the process, and nothing in Python can interrupt it: so a
file is tried first in a process of its own, with a time limit.
"""

from __future__ import annotations

import faulthandler
import os
import signal
import sys
import warnings
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from lusee_bayes.core.errors import InputError
from lusee_bayes.core.layouts import Content, Layout, Unloaded
from lusee_bayes.core.lazy import astropy_exceptions, fits, xarray
from lusee_bayes.core.reading import reading, require_file
from lusee_bayes.core.version import __version__

# a file is read whole up to this size; of a larger one, all metadata and the first value of each
# array
WHOLE_BYTES = 200_000_000
# a whole file of that size takes less than a tenth of it
LIMIT_S = 20.0
# what HDF5's library raises for a file that is damaged
DAMAGE = (OSError, KeyError, RuntimeError, ValueError, TypeError)


def require_readable_hdf5(path: Path) -> None:
    """Check that HDF5's library comes to an end with a file. What it raises is left to the reader.

    Raises
    ------
    InputError
        If it does not within ``LIMIT_S``, or if it ends the process.
    """
    status = path.stat()
    _probe(str(path), status.st_mtime_ns, status.st_size)


@lru_cache(maxsize=64)
def _probe(path: str, mtime_ns: int, size: int) -> None:
    # a process of macOS may not go on behind a fork
    if sys.platform != "linux":
        return
    with warnings.catch_warnings():
        # of threads that are not copied: the child needs none of them
        warnings.simplefilter("ignore")
        child = os.fork()
    if child == 0:
        # the kernel ends the child, whatever the library is doing
        signal.signal(signal.SIGALRM, signal.SIG_DFL)
        signal.setitimer(signal.ITIMER_REAL, LIMIT_S)
        _read_all(path, size)
    _, status = os.waitpid(child, 0)
    if os.WIFSIGNALED(status):
        endless = f"does not finish reading it within {LIMIT_S:g} s"
        why = endless if os.WTERMSIG(status) == signal.SIGALRM else "fails on it"
        raise InputError(f"{path} is damaged: HDF5's library {why}")


def _read_all(path: str, size: int) -> None:
    """In the child: read, and leave without a word."""
    try:
        # whatever it prints is of no use
        faulthandler.disable()
        os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
        with h5py.File(path) as file:
            # to look a name up may take forever where to list them fails at once
            with suppress(*DAMAGE):
                file.attrs.get("format")
            _read(file, size)
            file.visititems(lambda _, item: _read(item, size))
    finally:
        os._exit(0)


def _read(item: h5py.Group | h5py.Dataset, size: int) -> None:
    for name in item.attrs:
        with suppress(*DAMAGE):  # the reader says it
            item.attrs[name]
    if isinstance(item, h5py.Dataset) and item.size:
        whole = size <= WHOLE_BYTES and item.size * item.dtype.itemsize <= 5 * WHOLE_BYTES
        with suppress(*DAMAGE, MemoryError):
            item[()] if whole or not item.shape else item[(0,) * len(item.shape)]


VISIBILITIES = "lusee_bayes visibilities 1"
POSTERIOR = "lusee_bayes posterior 2"
SAMPLES = "lusee_bayes samples 1"
BEAMS = "lusee_bayes beams 1"
GAINS = "lusee_bayes gains 1"
REDUCED = "lusee_bayes reduced spectra 2"
DIAGNOSTICS = "lusee_bayes diagnostics 3"
CHANNEL = "lusee_bayes unfinished channel 1"
PAPER_CASE = "lusee_bayes paper case 1"

# words of the primary header that tell pyuvdata's beams from other FITS files
UVBEAM_WORDS = ("NORMSTD", "FEEDLIST")


def format_of(path: str | Path) -> str | None:
    """The attribute ``format`` of an HDF5 or netCDF file; None for files of other kinds.

    Raises
    ------
    InputError
        If there is no file, or it is HDF5 and damaged.
    """
    path = require_file(path, "file")
    with reading(path, "HDF5"):
        if not h5py.is_hdf5(path):
            return None
        require_readable_hdf5(path)
        with h5py.File(path) as file:
            kind = file.attrs.get("format")
    kind = kind.decode(errors="replace") if isinstance(kind, bytes) else kind
    return kind if isinstance(kind, str) else None


# dimensions that are the pixels of a HEALPix map in RING order
HEALPIX = ("pixel", "pixels", "region")


def header(format_: str) -> dict[str, str]:
    """Attributes of a file of the package: its format, conventions and version."""
    return {"Conventions": "CF-1.13", "format": format_, "lusee_bayes_version": __version__}


def with_grid(dataset: xarray.Dataset) -> xarray.Dataset:
    """The same with the grid of all arrays in pixels, of whole maps, as CF 1.13 has it."""
    for dim in {*HEALPIX} & {*dataset.dims}:
        n = dataset.sizes[dim]
        grid, index = f"{dim}_grid", f"{dim}_index"
        for variable in dataset.variables.values():
            if dim in variable.dims:
                variable.attrs["grid_mapping"] = grid
        mapping: dict[str, Any] = {"grid_mapping_name": "healpix", "indexing_scheme": "ring"}
        mapping["refinement_level"] = round(np.log2(n / 12) / 2)
        indices = {"standard_name": "healpix_index", "units": "1"}
        numbers = dim, np.arange(n, dtype=np.int32), indices, {"zlib": True, "shuffle": True}
        dataset = dataset.assign_coords({index: numbers}).assign({grid: ((), np.int8(0), mapping)})
    return dataset


# what the CF conventions call times, and what bounds may leave to the variable that they bound
CF_TIME = ("units", "calendar")


def read_netcdf(path: str | Path, format_: str, layout: Layout, hint: str = "") -> Content:
    """Read one of the package's own files.

    Dimensions are told by their names: an array whose dimensions are in another order is turned.
    Attributes of a variable are those of the file by the name ``variable.attribute``.

    Parameters
    ----------
    path : str or Path
    format_ : str
        Its ``format``, one of :mod:`.formats`.
    layout : Layout
    hint : str
        What to do if there is no such file.

    Returns
    -------
    Content

    Raises
    ------
    InputError
        If the file is missing, damaged or of another kind, or not as declared.
    """
    path = require_format(path, format_, layout.what, hint)
    opened_as = {"engine": "h5netcdf", "decode_times": False}
    with reading(path, layout.what), xarray.open_dataset(path, **opened_as) as dataset:
        arrays = {str(name): variable for name, variable in dataset.variables.items()}
        for name in arrays.keys() & layout.variables.keys():
            declared, dims = layout.variables[name], arrays[name].dims
            if set(dims) == set(declared.dims):
                arrays[name] = arrays[name].transpose(*declared.dims)
            if declared.kind == "time":
                arrays[name] = _decoded(dataset, name, arrays[name])
        said = {f"{name}.{key}": v for name, one in arrays.items() for key, v in one.attrs.items()}
        return layout.checked(path, arrays, said | dataset.attrs)


def _decoded(dataset: xarray.Dataset, name: str, variable: xarray.Variable) -> xarray.Variable:
    """Times by the CF conventions: bounds have the units of what they bound, if none of their own.

    Without units they stay numbers.
    """
    bounding = (v.attrs for v in dataset.variables.values() if v.attrs.get("bounds") == name)
    units = {key: v for attrs in bounding for key, v in attrs.items() if key in CF_TIME}
    with_units = variable.copy(deep=False)
    with_units.attrs = units | dict(variable.attrs)
    return xarray.conventions.decode_cf_variable(name, with_units)


def as_dataset(
    format_: str, layout: Layout, arrays: Mapping[str, Any], values: Mapping[str, Any]
) -> xarray.Dataset:
    """Lay out what :func:`read_netcdf` reads, on the dimensions and in the units of a layout.

    Parameters
    ----------
    format_ : str
        One of :mod:`.formats`.
    layout : Layout
    arrays : mapping of str to array or None
        By their names in the layout; None is absent.
    values : mapping of str to object
        Attributes, likewise; ``variable.attribute`` is one of a variable.
    """
    variables = {}
    for name in (name for name, array in arrays.items() if array is not None):
        declared = layout.variables[name]
        units = {"units": declared.unit or "1"} if declared.kind == "real" else {}
        variables[name] = (tuple(map(str, declared.dims)), arrays[name], units)
    dataset = xarray.Dataset(variables, attrs=header(format_))
    for name, value in values.items():
        variable, _, attribute = name.rpartition(".")
        if value is not None:
            (dataset[variable] if variable else dataset).attrs[attribute] = value
    return with_grid(dataset)


def require_format(path: str | Path, format_: str, what: str, hint: str = "") -> Path:
    """Check that a file is of one format of the package.

    Parameters
    ----------
    path : str or Path
    format_ : str
        Its ``format``, one of :mod:`.formats`.
    what : str
        What it should be, for messages.
    hint : str
        What to do if there is no such file.

    Raises
    ------
    InputError
        If the file is missing, damaged or of another kind.
    """
    path = require_file(path, what, hint)
    actual = format_of(path)
    if actual != format_:
        raise InputError(
            f"{path} does not contain {what}: its format is '{actual or 'absent'}', expected "
            f"'{format_}'" + (f"; {hint}" if hint else "")
        )
    return path


def says(path: Path, attributes: Mapping[str, str]) -> bool:
    """Tell whether a netCDF file of unfinished work is whole, and says so of itself.

    What is damaged is made anew, as what is not there.
    """
    try:
        with reading(path, "unfinished work"), h5py.File(path) as file:
            return all(file.attrs.get(name) == value for name, value in attributes.items())
    except InputError:
        return False


# words that say how a file is built
STRUCTURE = ("SIMPLE", "BITPIX", "NAXIS", "EXTEND", "COMMENT", "HISTORY")


def is_fits(path: str | Path) -> bool:
    """Return whether a file begins like FITS."""
    with Path(path).open("rb") as file:
        return file.read(6) == b"SIMPLE"


def image_names(path: str | Path) -> list[str]:
    """Return the names of all images and tables of a FITS file, in lower case.

    Raises
    ------
    InputError
        If the file cannot be read or is cut short.
    """
    with opened(path) as hdus:
        return [hdu.name.lower() for hdu in hdus]


def has_words(path: str | Path, words: Iterable[str]) -> bool:
    """Return whether a file is FITS and its primary header has all of these words.

    Raises
    ------
    InputError
        If it is FITS and cannot be read.
    """
    if not is_fits(path):
        return False
    with opened(path) as hdus:
        return all(word in hdus[0].header for word in words)


def read_fits(path: str | Path, layout: Layout, hint: str = "") -> Content:
    """Read images, columns of tables and words of the primary header.

    Variables are images by their names, or columns as ``table.column``; upper and lower case are
    the same. Attributes are words of the primary header. Units are BUNIT and TUNITn.

    Parameters
    ----------
    path : str or Path
    layout : Layout
    hint : str
        What to do if there is no such file.

    Returns
    -------
    Content

    Raises
    ------
    InputError
        If the file is missing or damaged, or not as declared.
    """
    with opened(path, layout.what, hint) as hdus:
        arrays: dict[str, Any] = {}
        words = hdus[0].header
        declared = {name.lower(): name for name in (*layout.variables, *layout.attributes)}
        keys = [key for key in words if key and not key.startswith(STRUCTURE)]
        said = {declared.get(key.lower(), key): words[key] for key in keys}

        def put(name: str, array: Any, unit: str | None) -> None:
            name = declared.get(name.lower(), name.lower())
            arrays[name] = array
            if unit is not None:
                said[f"{name}.units"] = unit

        for hdu in hdus:
            if isinstance(hdu, fits.BinTableHDU | fits.TableHDU):
                for number, column in enumerate(hdu.columns):
                    put(f"{hdu.name}.{column.name}", hdu.data.field(number), column.unit)
            elif hdu.header.get("NAXIS", 0):
                put(hdu.name, unread_image(hdu), hdu.header.get("BUNIT"))
        return layout.checked(path, arrays, said)


def unread_image(hdu: fits.PrimaryHDU | fits.ImageHDU) -> Unloaded:
    """The image of an open FITS file."""
    dtype = np.dtype(fits.BITPIX2DTYPE[hdu.header["BITPIX"]])
    return Unloaded(tuple(hdu.shape), dtype, partial(getattr, hdu, "data"))


@contextmanager
def opened(path: str | Path, what: str = "FITS", hint: str = "") -> Iterator[fits.HDUList]:
    """Open a FITS file for the duration of a ``with`` block.

    Raises
    ------
    InputError
        If the file, or what the block reads of it, is cut short or damaged.
    """
    with reading(path, what, hint) as place, place.open("rb") as file:
        # astropy only warns of a file that is cut short
        warnings.simplefilter("error", astropy_exceptions.AstropyWarning)
        try:
            hdus = fits.open(file, memmap=False)
        except OSError as error:
            if "SIMPLE" not in str(error):
                raise
            raise InputError(f"{path} cannot be read as {what}: it is not a FITS file") from error
        with hdus:
            yield hdus


def is_session(path: str | Path) -> bool:
    """Return whether a file says that it is a session of the spectrometer.

    Raises
    ------
    InputError
        If there is no file, or it is damaged.
    """
    path = require_file(path, "data")
    with reading(path, "a session in HDF5"):
        if h5py.is_hdf5(path):
            with h5py.File(path) as file:
                return "layout_version" in file.attrs
    return has_words(path, ["LAYOUTV"])
