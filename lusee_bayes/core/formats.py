"""Names of the package's own file formats: every file says which one it is, in ``format``."""

from __future__ import annotations

from pathlib import Path

import h5py

from lusee_bayes.core.hdf5_probe import require_readable_hdf5
from lusee_bayes.core.reading import reading, require_file

VISIBILITIES = "lusee_bayes visibilities 1"
POSTERIOR = "lusee_bayes posterior 1"
POSTERIOR_CUBE = "lusee_bayes posterior cube 1"
SAMPLES = "lusee_bayes samples 1"
BEAMS = "lusee_bayes beams 1"
GAINS = "lusee_bayes gains 1"
REDUCED = "lusee_bayes reduced spectra 1"
DIAGNOSTICS = "lusee_bayes diagnostics 2"
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
