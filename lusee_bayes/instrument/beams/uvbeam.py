"""pyuvdata's UVBeam as sampled beams; pyuvdata is optional (the extra ``uvdata``).

A UVBeam of type efield holds, for every feed, the response to the components of the field along
azimuth and zenith angle (``az_za``), or along phi and theta (``healpix``); azimuth is phi, from
East towards North.
"""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from lusee_bayes.core.errors import InputError
from lusee_bayes.core.files import user_path
from lusee_bayes.core.formats import UVBEAM_WORDS, has_words
from lusee_bayes.core.lazy import pyuvdata
from lusee_bayes.core.reading import reading
from lusee_bayes.instrument.beams.sampled import SampledBeams, sampled_beams


def is_uvbeam_file(path: str | Path) -> bool:
    """Whether there is a beam FITS file of pyuvdata at a path."""
    path = user_path(path)
    return path.is_file() and has_words(path, UVBEAM_WORDS)


def read_uvbeam(path: str | Path) -> SampledBeams:
    """Read a beam FITS file of pyuvdata.

    Parameters
    ----------
    path : str or Path

    Returns
    -------
    SampledBeams

    Raises
    ------
    InputError
        If pyuvdata is not installed, or as :func:`from_uvbeam`.
    """
    if find_spec("pyuvdata") is None:
        raise InputError(
            f"{path} is a beam file of pyuvdata, which is not installed; install it with "
            "pip install '.[uvdata]' in the clone of lusee_bayes"
        )
    with reading(path, "a beam file of pyuvdata") as file:
        beam = pyuvdata.UVBeam.from_file(str(file))
    return from_uvbeam(beam, path=str(path))


def from_uvbeam(beam: Any, *, conjugate: bool = False, path: str = "the UVBeam") -> SampledBeams:
    """Convert a UVBeam of type efield, one port for every feed.

    Parameters
    ----------
    beam : pyuvdata.UVBeam
        Of type efield, in coordinates az_za or healpix (RING); scaled so that the autos integrate
        to one, as UVBeams are in units of their own.
    conjugate : bool
        Take the complex conjugates: for fields that were made with exp(-i w t).
    path : str
        Where it comes from, for messages.

    Returns
    -------
    SampledBeams

    Raises
    ------
    InputError
        For beams of another type, coordinates or basis, pixels that do not cover the sky, or as
        :func:`sampled_beams`.
    """
    if beam.beam_type != "efield":
        raise InputError(
            f"{path} is a UVBeam of type {beam.beam_type}; give one of type efield, since the "
            "crosses between ports need fields"
        )
    system = beam.pixel_coordinate_system
    if system not in ("az_za", "healpix"):
        raise InputError(f"{path} has coordinates {system}; expected az_za or healpix")
    basis = np.asarray(beam.basis_vector_array)
    unit = np.zeros_like(basis)
    unit[0, 0] = unit[1, 1] = 1.0
    if basis.shape[:2] != (2, 2) or not np.allclose(basis, unit, atol=1e-9):
        raise InputError(
            f"{path} has fields along other vectors than azimuth and zenith angle; convert it "
            "first (basis_vector_array is not the unit matrix)"
        )
    # (vector, feed, frequency, ...) to (frequency, feed, ...)
    along_phi, along_theta = np.swapaxes(np.asarray(beam.data_array), 1, 2)
    angles: dict[str, np.ndarray] = {}
    if system == "az_za":
        angles["theta_deg"] = np.round(np.degrees(beam.axis2_array), 9)
        angles["phi_deg"] = np.round(np.degrees(beam.axis1_array), 9)
    else:
        n = 12 * int(beam.nside) ** 2
        if beam.ordering != "ring" or not np.array_equal(beam.pixel_array, np.arange(n)):
            raise InputError(
                f"{path} has {len(beam.pixel_array)} pixels in {beam.ordering} order; expected all "
                f"{n} of NSIDE {beam.nside}, in ring order"
            )
    fields = {"e_theta": along_theta, "e_phi": along_phi}
    if conjugate:
        fields = {name: one.conj() for name, one in fields.items()}
    return sampled_beams(np.asarray(beam.freq_array) / 1e6, **fields, **angles, path=path)
