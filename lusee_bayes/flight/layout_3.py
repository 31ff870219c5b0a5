"""Layout 3 of ``lusee.ingest``, in HDF5 and in FITS: the same with other names."""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from astropy.io import fits

from lusee_bayes.core.errors import InputError
from lusee_bayes.core.formats import unread_image
from lusee_bayes.core.layouts import Attribute, Content, Layout, Unread
from lusee_bayes.core.reading import table_beside
from lusee_bayes.flight.clock import DAY_S, MJD_ZERO, SAME_S, Clock
from lusee_bayes.flight.session import META, ROWS, SAID, TELEMETRY, Session, session_of
from lusee_bayes.instrument.times import scale_of

INTERPOLATED = "spectra_interpolated_telemetry"
# luseepy's word for the scale of a mission clock that nobody has established
UNKNOWN = "unknown"
CLOCK_WORDS = {
    "constants.raw_time_subtract_seconds": Attribute(),
    "constants.mjd_epoch_offset_days": Attribute(),
    "constants.time_scale": Attribute("text", optional=True),
}
LAYOUT_3 = Layout("a session of lusee.ingest, layout 3", ROWS, SAID | CLOCK_WORDS)
# tables of FITS, and the prefixes of their columns' names in HDF5
TABLES = {"SPECTRA_TIMES": "spectra", "SPECTRA_META": META, "SPEC_INTERP": "telemetry"}
# columns and words that have another name in FITS: words by table
COLUMNS = {"spectra/RAW_TIME": "spectra/raw_times", "spectra/MJD_TIME": "spectra/mjd_times"}
WORDS: dict[str, dict[str, str]] = table_beside(__file__)


def said_in(file: Mapping[str, Any]) -> dict[str, Any]:
    """Return the attributes of an open HDF5 file, by names as in :data:`.SAID`."""
    return {
        f"{name}.{key}": value
        for name in ("constants", "session_invariants", "spectra/data")
        if name in file
        for key, value in file[name].attrs.items()
    }


def no_spectra(path: Path, lacking: str, names: Iterable[str]) -> InputError:
    """Return the error for a file without spectra, with a list of its contents."""
    has = ", ".join(names) or "nothing"
    return InputError(f"{path} has no {lacking}: it contains no spectra, but {has}")


def session_of_hdf5(path: Path, file: h5py.File) -> Session:
    """Create a session from an open HDF5 file.

    Parameters
    ----------
    path : Path
    file : h5py.File

    Raises
    ------
    InputError
        If something is missing or invalid.
    """
    if "spectra" not in file or "data" not in file["spectra"]:
        raise no_spectra(path, "spectra/data", file)
    arrays: dict[str, Unread] = {
        f"{group}/{name}": item
        for group in ("spectra", META)
        if group in file
        for name, item in file[group].items()
        if isinstance(item, h5py.Dataset)
    }
    group = file.get(INTERPOLATED, {})
    if "time" in group and "raw_times" in file["spectra"]:
        theirs, ours = np.asarray(group["time"]), np.asarray(file["spectra/raw_times"])
        if not np.array_equal(theirs, ours):
            raise InputError(f"{path}: {INTERPOLATED}/time differs from the times of the spectra")
    arrays |= {f"telemetry/{name}": group[name] for name in TELEMETRY if name in group}
    return _checked_session(path, "HDF5", arrays, said_in(file))


def session_of_fits(path: Path, hdus: fits.HDUList) -> Session:
    """Create a session from an open FITS file, as :func:`session_of_hdf5`."""
    names = [hdu.name for hdu in hdus]
    if "SPECTRA" not in names:
        raise no_spectra(path, "image SPECTRA", names[1:])
    arrays: dict[str, Unread] = {"spectra/data": unread_image(hdus["SPECTRA"])}
    for table in [table for table in TABLES if table in names]:
        for column in hdus[table].columns.names:
            name = f"{TABLES[table]}/{column}"
            arrays[COLUMNS.get(name, name)] = np.asarray(hdus[table].data[column])
    values: dict[str, Any] = {
        ours: hdus[hdu].header[word]
        for hdu in [hdu for hdu in WORDS if hdu in names]
        for word, ours in WORDS[hdu].items()
        if word in hdus[hdu].header
    }
    return _checked_session(path, "FITS", arrays, values)


def _checked_session(
    path: Path, kind: str, arrays: dict[str, Any], values: dict[str, Any]
) -> Session:
    content = LAYOUT_3.checked(path, arrays, values)
    clock = _clock_by_epoch(path, content)
    return session_of(path, content, arrays, layout=3, kind=kind, clock=clock)


def _clock_by_epoch(path: Path, content: Content) -> Clock | None:
    scale = content.values.get("constants.time_scale", UNKNOWN).lower()
    mjd = content.values["constants.mjd_epoch_offset_days"]
    # luseepy writes zero if the epoch is unknown
    if mjd == 0.0:
        return None
    raw_s = content.values["constants.raw_time_subtract_seconds"]
    readings = content.arrays["spectra/raw_times"]
    by_epoch = mjd + (readings - raw_s) / DAY_S
    theirs = content.arrays.get("spectra/mjd_times", by_epoch)
    if (off := np.flatnonzero(np.abs(theirs - by_epoch) > SAME_S / DAY_S)).size:
        k = int(off[0])
        raise InputError(
            f"{path}: mjd_times of spectrum {k} is {theirs[k]:.9g}, raw_times {readings[k]:.9g} s "
            f"with the epoch of the constants {by_epoch[k]:.9g}; ingest the session again"
        )
    if scale == UNKNOWN:
        return None
    return Clock(str(path), MJD_ZERO, mjd, scale_of(f"{path}: time_scale", scale), raw_s)
