"""Read beam files: luseepy's, scalar or four-port, sampled beams, and pyuvdata's UVBeam."""

from __future__ import annotations

from pathlib import Path

from lusee_bayes.core.errors import InputError
from lusee_bayes.core.formats import image_names, is_fits
from lusee_bayes.core.reading import require_file
from lusee_bayes.instrument.beams.response_file import PortResponse, read_response
from lusee_bayes.instrument.beams.sampled import SampledBeams
from lusee_bayes.instrument.beams.sampled_file import is_sampled_file, read_sampled_beams
from lusee_bayes.instrument.beams.scalar_file import ScalarBeam, read_scalar_beam
from lusee_bayes.instrument.beams.uvbeam import is_uvbeam_file, read_uvbeam


def read_beam(path: str | Path) -> ScalarBeam | PortResponse | SampledBeams:
    """Read a beam file of whichever kind.

    luseepy's scalar beams (FITS version 2) and responses (version 3), sampled beams
    (:mod:`.sampled_file`), and pyuvdata's beam FITS (:mod:`.uvbeam`).

    Parameters
    ----------
    path : str or Path

    Returns
    -------
    ScalarBeam, PortResponse or SampledBeams

    Raises
    ------
    InputError
        If there is no file, or as the reader of its kind.
    """
    path = require_file(path, "beam file", "check beam.file")
    return READERS[kind_of(path)](path)


def kind_of(path: str | Path) -> str:
    """Return the kind of a beam file, the ``model`` of a scenario; others are luseepy's scalar.

    Raises
    ------
    InputError
        If the file is FITS or HDF5, and damaged.
    """
    try:
        path = require_file(path, "beam file")
    except InputError:
        return "luseepy"
    if is_sampled_file(path) or is_uvbeam_file(path):
        return "sampled"
    if is_fits(path) and "h_theta_real" in image_names(path):
        return "response"
    return "luseepy"


def read_sampled(path: str | Path) -> SampledBeams:
    """Read sampled beams, the package's own files or pyuvdata's.

    Raises
    ------
    InputError
        As :func:`read_sampled_beams` and :func:`read_uvbeam`.
    """
    return read_uvbeam(path) if is_uvbeam_file(path) else read_sampled_beams(path)


READERS = {"sampled": read_sampled, "response": read_response, "luseepy": read_scalar_beam}
