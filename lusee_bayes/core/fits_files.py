"""Read FITS files by their declared layouts."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from astropy.io import fits
from astropy.utils.exceptions import AstropyWarning

from lusee_bayes.core.errors import InputError
from lusee_bayes.core.layouts import Content, Layout
from lusee_bayes.core.reading import reading

# kinds of numbers that images hold, by BITPIX
IMAGE_DTYPES = {8: "u1", 16: "i2", 32: "i4", 64: "i8", -32: "f4", -64: "f8"}

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
        said = {key: words[key] for key in words if key and not key.startswith(STRUCTURE)}
        declared = {name.lower(): name for name in layout.variables}

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
                put(hdu.name, _Image(hdu), hdu.header.get("BUNIT"))
        return layout.checked(path, arrays, said)


class _Image:
    """An image that is read when it is asked for."""

    def __init__(self, hdu: fits.PrimaryHDU | fits.ImageHDU):
        self._hdu = hdu
        self.shape = tuple(hdu.shape)
        self.dtype = np.dtype(IMAGE_DTYPES[hdu.header["BITPIX"]])

    @cached_property
    def _values(self) -> np.ndarray:
        return np.asarray(self._hdu.data)

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> np.ndarray:
        return self._values.astype(self.dtype if dtype is None else dtype)


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
        warnings.simplefilter("error", AstropyWarning)
        try:
            hdus = fits.open(file, memmap=False)
        except OSError as error:
            if "SIMPLE" not in str(error):
                raise
            raise InputError(f"{path} cannot be read as {what}: it is no FITS file") from error
        with hdus:
            yield hdus
