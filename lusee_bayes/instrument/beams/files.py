"""Read the beam files of luseepy, scalar or four-port."""

from __future__ import annotations

from pathlib import Path

from lusee_bayes.core.errors import InputError
from lusee_bayes.core.fits_files import image_names, is_fits
from lusee_bayes.core.reading import require_file
from lusee_bayes.instrument.beams.response_file import PortResponse, read_response
from lusee_bayes.instrument.beams.scalar_file import ScalarBeam, read_scalar_beam


def read_beam(path: str | Path) -> ScalarBeam | PortResponse:
    """Read a beam file of luseepy: a scalar beam (FITS version 2) or a response (version 3).

    Parameters
    ----------
    path : str or Path

    Returns
    -------
    ScalarBeam or PortResponse

    Raises
    ------
    InputError
        If there is no file, or as :func:`read_scalar_beam` and :func:`read_response`.
    """
    path = require_file(path, "beam file", "check beam.file")
    names = set(image_names(path))
    return read_response(path) if "h_theta_real" in names else read_scalar_beam(path)


def is_response(path: str | Path) -> bool:
    """Whether there is a four-port response of luseepy at a path."""
    try:
        path = require_file(path, "beam file")
    except InputError:
        return False
    return is_fits(path) and "h_theta_real" in image_names(path)
