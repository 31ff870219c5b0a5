"""Sessions of ``lusee.ingest`` in FITS, layout 3: the same as in HDF5, under other names."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from astropy.io import fits
from jaxtyping import Shaped

from lusee_bayes.core.errors import InputError
from lusee_bayes.core.fits_files import IMAGE_DTYPES, opened
from lusee_bayes.core.layouts import Unread
from lusee_bayes.instrument.flight.session import Read, Session
from lusee_bayes.instrument.flight.session_layout import META, require_version, session_of

WHAT = "a session of lusee.ingest in FITS"
# tables, with what comes before the names of their columns in HDF5
TABLES = {"SPECTRA_TIMES": "spectra", "SPECTRA_META": META, "SPEC_INTERP": "telemetry"}
# columns and words that have another name there
COLUMNS = {"spectra/RAW_TIME": "spectra/raw_times", "spectra/MJD_TIME": "spectra/mjd_times"}
WORDS = {
    "CONSTANTS": {
        "LUN_LAT": "constants.lun_lat_deg",
        "LUN_LON": "constants.lun_long_deg",
        "RAWSHFT": "constants.raw_time_subtract_seconds",
        "MJDOFF": "constants.mjd_epoch_offset_days",
        "TIMESYS": "constants.time_scale",
    },
    "SESSION_INV": {"SW_VERS": "session_invariants.software_version"},
    "SPECTRA": {
        "BUNIT": "spectra/data.units",
        "REPRESENTATION": "spectra/data.representation",
        "BITSREST": "spectra/data.bitslice_restored",
        "BITSREF": "spectra/data.bitslice_reference",
        "NORMVER": "spectra/data.normalization_version",
    },
}


class _Cube:
    """The spectra, not yet read."""

    def __init__(self, hdu: fits.ImageHDU):
        self.shape = tuple(hdu.shape)
        self.dtype = np.dtype(IMAGE_DTYPES[hdu.header["BITPIX"]])


def is_fits_session(path: Path) -> bool:
    """Return whether a FITS file is a session of ``lusee.ingest``."""
    with opened(path) as hdus:
        return "LAYOUTV" in hdus[0].header


def read_fits_session(path: Path) -> Session:
    """Read everything of a session but its spectra.

    Parameters
    ----------
    path : Path

    Raises
    ------
    InputError
        For a file that is damaged, of another kind or of another version, and for whatever it
        lacks.
    """
    with opened(path, WHAT) as hdus:
        version = require_version(path, hdus[0].header.get("LAYOUTV"))
        if version == 4:
            raise InputError(
                f"{path} is of layout 4 in FITS; this version reads layout 4 in HDF5: ingest the "
                "session again with luseepy, as HDF5"
            )
        names = [hdu.name for hdu in hdus]
        if "SPECTRA" not in names:
            raise InputError(
                f"{path} has no image SPECTRA: the session holds no spectra (it has "
                f"{', '.join(names[1:]) or 'nothing'})"
            )
        arrays: dict[str, Unread | _Cube] = {"spectra/data": _Cube(hdus["SPECTRA"])}
        for table, place in TABLES.items():
            if table not in names:
                continue
            for column in hdus[table].columns.names:
                name = f"{place}/{column}"
                arrays[COLUMNS.get(name, name)] = np.asarray(hdus[table].data[column])
        values: dict[str, Any] = {
            ours: hdus[hdu].header[word]
            for hdu, words in WORDS.items()
            if hdu in names
            for word, ours in words.items()
            if word in hdus[hdu].header
        }
        return session_of(path, version, "FITS", arrays, values, None, _opener(path))


def _opener(path: Path) -> Callable[[], AbstractContextManager[Read]]:
    @contextmanager
    def spectra() -> Iterator[Read]:
        with opened(path, WHAT) as hdus:
            cube = hdus["SPECTRA"].section

            def read(first: int, last: int) -> Shaped[np.ndarray, "rows products channels"]:
                return np.asarray(cube[first:last], dtype=np.float32)

            yield read

    return spectra
