"""Beam files, whatever kind they are."""

from __future__ import annotations

from pathlib import Path

from lusee_bayes.beams.response_file import PortResponse, read_response
from lusee_bayes.beams.scalar_file import ScalarBeam, read_scalar_beam
from lusee_bayes.checks import InputError
from lusee_bayes.fits_images import image_names


def read_beam(path: str | Path) -> ScalarBeam | PortResponse:
    """Read a beam file of luseepy: scalar (FITS version 2) or four-port response (version 3).

    InputError as :func:`read_scalar_beam` and :func:`read_response`.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"no beam file at '{path}'; check beam.file")
    names = set(image_names(path))
    return read_response(path) if "h_theta_real" in names else read_scalar_beam(path)
