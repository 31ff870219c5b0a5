"""HDF5, netCDF and FITS files, read by their declared layouts.

Every file of the package states its format in the attribute ``format``. On damaged metadata, the
HDF5 library may loop forever or crash, and Python cannot interrupt it. A separate process therefore
reads each file first, with a time limit.
"""

from __future__ import annotations

import faulthandler
import io
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

# files up to this size are read whole; of a larger one, all metadata and the first value of each
# array
WHOLE_BYTES = 200_000_000
# reading a whole file of that size takes less than a tenth of this
LIMIT_S = 20.0
# errors that the HDF5 library raises for a damaged file
DAMAGE = (OSError, KeyError, RuntimeError, ValueError, TypeError)


def require_readable_hdf5(path: Path) -> None:
    """Check that the HDF5 library finishes reading a file; its errors are left to the reader.

    Raises
    ------
    InputError
        If it does not finish within ``LIMIT_S``, or crashes the process.
    """
    status = path.stat()
    _probe(str(path), status.st_mtime_ns, status.st_size)


@lru_cache(maxsize=64)
def _probe(path: str, mtime_ns: int, size: int) -> None:
    # on macOS, a forked process may not continue
    if sys.platform != "linux":
        return
    with warnings.catch_warnings():
        # ignore the warning that threads are not copied: the child needs none of them
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
    """In the child process: read the file, then exit silently."""
    try:
        # discard everything that it prints
        faulthandler.disable()
        os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
        with h5py.File(path) as file:
            # looking up a name may loop forever where listing the names fails immediately
            with suppress(*DAMAGE):
                file.attrs.get("format")
            _read(file, size)
            file.visititems(lambda _, item: _read(item, size))
    finally:
        os._exit(0)


def _read(item: h5py.Group | h5py.Dataset, size: int) -> None:
    for name in item.attrs:
        with suppress(*DAMAGE):  # the reader reports it
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
DIAGNOSTICS = "lusee_bayes diagnostics 4"
SPECTRUM = "lusee_bayes spectrum 1"
CHANNEL = "lusee_bayes unfinished channel 1"
PAPER_CASE = "lusee_bayes paper case 1"

# keywords of the primary header that distinguish pyuvdata's beams from other FITS files
UVBEAM_WORDS = ("NORMSTD", "FEEDLIST")


def format_of(path: str | Path) -> str | None:
    """The attribute ``format`` of an HDF5 or netCDF file; None for files of other kinds.

    Raises
    ------
    InputError
        If there is no file, or it is a damaged HDF5 file.
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
    """Return the dataset with the CF 1.13 grid mapping of its HEALPix arrays, all whole maps."""
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


class _File(io.FileIO):
    """A file that keeps the first error of writing; what is written after it is lost.

    The HDF5 library crashes the process if it cannot write what remains when a file is closed.
    """

    error: OSError | None = None

    def write(self, data):
        left = memoryview(data).cast("B")
        try:
            while self.error is None and left:
                left = left[super().write(left) :]
        except OSError as error:
            self.error = error
        return memoryview(data).nbytes


@contextmanager
def hdf5_file(path: Path) -> Iterator[io.FileIO]:
    """Open a new file for the HDF5 library; the block ends with the OSError of a full disk."""
    with _File(path, "w+b") as file:
        try:
            yield file
        finally:
            if file.error is not None:
                raise file.error


def write_netcdf(content: xarray.Dataset | xarray.DataTree, path: Path) -> None:
    """Write a netCDF file."""
    with hdf5_file(path) as file:
        content.to_netcdf(file, engine="h5netcdf")


# time attributes of the CF conventions; bounds may inherit them from the variable that they bound
CF_TIME = ("units", "calendar")


def read_netcdf(path: str | Path, format_: str, layout: Layout, hint: str = "") -> Content:
    """Read one of the package's own files.

    Dimensions are identified by name: arrays with their dimensions in another order are transposed.
    An attribute of a variable counts as an attribute ``variable.attribute`` of the file.

    Parameters
    ----------
    path : str or Path
    format_ : str
        Its ``format``, one of :mod:`.formats`.
    layout : Layout
    hint : str
        Advice in case there is no such file.

    Returns
    -------
    Content

    Raises
    ------
    InputError
        If the file is missing, damaged, of another kind, or not as declared.
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
    """Decode times by the CF conventions; bounds without units inherit those of their variable.

    Times without any units stay numbers.
    """
    bounding = (v.attrs for v in dataset.variables.values() if v.attrs.get("bounds") == name)
    units = {key: v for attrs in bounding for key, v in attrs.items() if key in CF_TIME}
    with_units = variable.copy(deep=False)
    with_units.attrs = units | dict(variable.attrs)
    return xarray.conventions.decode_cf_variable(name, with_units)


def as_dataset(
    format_: str, layout: Layout, arrays: Mapping[str, Any], values: Mapping[str, Any]
) -> xarray.Dataset:
    """Build the dataset that :func:`read_netcdf` reads, with the dimensions and units of a layout.

    Parameters
    ----------
    format_ : str
        One of :mod:`.formats`.
    layout : Layout
    arrays : mapping of str to array or None
        Arrays by their names in the layout; None is absent.
    values : mapping of str to object
        Attributes by name; ``variable.attribute`` is an attribute of a variable. None is absent.
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
    """Check that a file has a given format of the package.

    Parameters
    ----------
    path : str or Path
    format_ : str
        Its ``format``, one of :mod:`.formats`.
    what : str
        Description of the expected file, for messages.
    hint : str
        Advice in case there is no such file.

    Raises
    ------
    InputError
        If the file is missing, damaged or of another kind.
    """
    path = require_file(path, what, hint)
    if (actual := format_of(path)) != format_:
        raise InputError(
            f"{path} does not contain {what}: its format is '{actual or 'absent'}', expected "
            f"'{format_}'" + (f"; {hint}" if hint else "")
        )
    return path


def says(path: Path, attributes: Mapping[str, str]) -> bool:
    """Whether a netCDF file of unfinished work is readable and has these attributes.

    A damaged file counts as missing, so that it is computed again.
    """
    try:
        with reading(path, "unfinished work"), h5py.File(path) as file:
            return all(file.attrs.get(name) == value for name, value in attributes.items())
    except InputError:
        return False


# FITS keywords that describe the structure of a file
STRUCTURE = ("SIMPLE", "BITPIX", "NAXIS", "EXTEND", "COMMENT", "HISTORY")


def is_fits(path: str | Path) -> bool:
    """Return whether a file begins like a FITS file."""
    with Path(path).open("rb") as file:
        return file.read(6) == b"SIMPLE"


def image_names(path: str | Path) -> list[str]:
    """Return the names of all images and tables of a FITS file, in lower case.

    Raises
    ------
    InputError
        If the file is unreadable or truncated.
    """
    with opened(path) as hdus:
        return [hdu.name.lower() for hdu in hdus]


def has_words(path: str | Path, words: Iterable[str]) -> bool:
    """Return whether a file is FITS and its primary header has all of these keywords.

    Raises
    ------
    InputError
        If it is FITS but cannot be read.
    """
    if not is_fits(path):
        return False
    with opened(path) as hdus:
        return all(word in hdus[0].header for word in words)


def read_fits(path: str | Path, layout: Layout, hint: str = "") -> Content:
    """Read images, table columns and keywords of the primary header.

    Variables are images by name, or columns as ``table.column``; case is ignored. Attributes are
    keywords of the primary header. Units come from BUNIT and TUNITn.

    Parameters
    ----------
    path : str or Path
    layout : Layout
    hint : str
        Advice in case there is no such file.

    Returns
    -------
    Content

    Raises
    ------
    InputError
        If the file is missing, damaged, or not as declared.
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
    """The image of an HDU, not yet read."""
    dtype = np.dtype(fits.BITPIX2DTYPE[hdu.header["BITPIX"]])
    return Unloaded(tuple(hdu.shape), dtype, partial(getattr, hdu, "data"))


@contextmanager
def opened(path: str | Path, what: str = "FITS", hint: str = "") -> Iterator[fits.HDUList]:
    """Open a FITS file for the duration of a ``with`` block.

    Raises
    ------
    InputError
        If the file, or a part that the block reads, is truncated or damaged.
    """
    with reading(path, what, hint) as place, place.open("rb") as file:
        # astropy only warns about a truncated file
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
    """Return whether a file is marked as a spectrometer session.

    Raises
    ------
    InputError
        If the file is missing or damaged.
    """
    path = require_file(path, "data")
    with reading(path, "a session in HDF5"):
        if h5py.is_hdf5(path):
            with h5py.File(path) as file:
                return "layout_version" in file.attrs
    return has_words(path, ["LAYOUTV"])
