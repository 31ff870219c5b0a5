"""Sessions of ``lusee.ingest``, of whatever layout and kind of file."""

from __future__ import annotations

from pathlib import Path

import h5py

from lusee_bayes.core.errors import InputError
from lusee_bayes.core.fits_files import is_fits
from lusee_bayes.core.reading import reading, require_file
from lusee_bayes.instrument.flight.session import Session
from lusee_bayes.instrument.flight.session_fits import is_fits_session, read_fits_session
from lusee_bayes.instrument.flight.session_hdf5 import WHAT, read_hdf5_session


def is_session(path: str | Path) -> bool:
    """Return whether a file says that it is a session.

    Raises
    ------
    InputError
        If there is no file, or it is damaged.
    """
    path = require_file(path, "data")
    if is_fits(path):
        return is_fits_session(path)
    with reading(path, WHAT):
        if not h5py.is_hdf5(path):
            return False
        with h5py.File(path) as file:
            return "layout_version" in file.attrs


def read_session(path: str | Path) -> Session:
    """Read everything of a session but its spectra, which stay in the file.

    Parameters
    ----------
    path : str or Path
        HDF5 or FITS, of layout 3 or 4.

    Raises
    ------
    InputError
        For a file that is missing, damaged, of another kind or version, and for whatever it lacks.
    """
    path = require_file(path, "a session")
    if is_fits(path):
        return read_fits_session(path)
    with reading(path, WHAT):
        hdf5 = h5py.is_hdf5(path)
    if not hdf5:
        raise InputError(f"{path} is neither HDF5 nor FITS, and so no session of lusee.ingest")
    return read_hdf5_session(path)
