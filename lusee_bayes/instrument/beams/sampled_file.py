"""Files of beams of one's own: netCDF, or FITS with images of the same names.

``frequency_mhz`` (frequency), growing; then either ``e_theta_real``, ``e_theta_imag``,
``e_phi_real`` and ``e_phi_imag`` (frequency, antenna, directions), or ``product_beam`` (frequency,
product, directions). Directions are (theta, phi) with ``theta_deg`` (theta) and ``phi_deg`` (phi),
or (pixel): HEALPix, RING. Attributes, words of the primary header in FITS: ``format``, ``absolute``
(0 or 1, see :class:`.SampledBeams`), and ``products``, the labels of product beams in their order.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import xarray as xr
from astropy.io import fits

from lusee_bayes.core import formats
from lusee_bayes.core.errors import InputError
from lusee_bayes.core.files import replacing, user_path
from lusee_bayes.core.formats import image_names, is_fits, read_fits, read_netcdf
from lusee_bayes.core.layouts import Attribute, Layout, Variable
from lusee_bayes.core.reading import naming
from lusee_bayes.instrument.beams.sampled import SampledBeams, sampled_beams
from lusee_bayes.instrument.products import labels

FIELDS = ("e_theta_real", "e_theta_imag", "e_phi_real", "e_phi_imag")
POWER = "product_beam"
WHAT = "sampled beams"
HINT = "lusee_bayes.sampled_beams(...).write makes one of arrays"


def layout(*, fields: bool, grid: bool, upper: bool = False) -> Layout:
    """Return what a file holds.

    Parameters
    ----------
    fields : bool
        Whether it has fields, not product beams.
    grid : bool
        Whether it has a grid, not HEALPix pixels.
    upper : bool
        Whether attributes are words of a FITS header.
    """
    directions = ("theta", "phi") if grid else ("pixel",)
    first = "antenna" if fields else "product"
    # below the horizon there may be anything
    values = Variable(("frequency", first, *directions), missing=True)
    angles = {
        "theta_deg": Variable(("theta",), low=0.0, high=180.0, grows=True, unit="deg"),
        "phi_deg": Variable(("phi",), low=0.0, high=360.0, grows=True, unit="deg"),
    }
    attributes = {
        "absolute": Attribute("boolean"),
        "products": Attribute("text", optional=fields),
    }
    return Layout(
        WHAT,
        {
            "frequency_mhz": Variable(("frequency",), low=0.0, grows=True, unit="MHz"),
            **dict.fromkeys(FIELDS if fields else (POWER,), values),
            **(angles if grid else {}),
        },
        {name.upper() if upper else name: one for name, one in attributes.items()},
    )


def is_sampled_file(path: str | Path) -> bool:
    """Whether there is a file of this layout at a path."""
    path = user_path(path)
    if not path.is_file():
        return False
    if is_fits(path):
        return bool({FIELDS[0], POWER} & set(image_names(path)))
    return formats.format_of(path) == formats.BEAMS


def read_sampled_beams(path: str | Path) -> SampledBeams:
    """Read a file that :func:`write_sampled_beams` has written, or one of the same layout.

    Parameters
    ----------
    path : str or Path

    Returns
    -------
    SampledBeams

    Raises
    ------
    InputError
        If the file is missing, damaged or of another kind, or not as declared.
    """
    path = user_path(path)
    in_fits = path.is_file() and is_fits(path)
    if in_fits:
        there = frozenset(image_names(path))
    else:
        there = read_netcdf(path, formats.BEAMS, Layout(WHAT), HINT).there
    declared = layout(fields=POWER not in there, grid="theta_deg" in there, upper=in_fits)
    if in_fits:
        found = read_fits(path, declared, HINT)
    else:
        found = read_netcdf(path, formats.BEAMS, declared, HINT)
    arrays, said = found.arrays, {key.lower(): value for key, value in found.values.items()}
    given: dict[str, np.ndarray] = {}
    if POWER in arrays:
        with naming(path):
            given["products"] = _in_order(arrays[POWER], said["products"])
    else:
        parts = [arrays[name] for name in FIELDS]
        # set part by part: infinity times 1j would be NaN, with a warning
        given["e_theta"], given["e_phi"] = np.empty((2, *parts[0].shape), dtype=complex)
        given["e_theta"].real, given["e_theta"].imag = parts[0], parts[1]
        given["e_phi"].real, given["e_phi"].imag = parts[2], parts[3]
    return sampled_beams(
        arrays["frequency_mhz"],
        **given,
        theta_deg=arrays.get("theta_deg"),
        phi_deg=arrays.get("phi_deg"),
        absolute=said["absolute"],
        path=str(path),
    )


def write_sampled_beams(path: str | Path, beams: SampledBeams) -> Path:
    """Write beams to netCDF, or to FITS where the name ends in .fits; whole or not at all.

    Parameters
    ----------
    path : str or Path
    beams : SampledBeams

    Returns
    -------
    Path
    """
    path, fields = user_path(path), beams.products is None
    grid = beams.directions.theta is not None
    arrays = {"frequency_mhz": beams.frequencies_mhz}
    if fields:
        parts = (beams.e_theta.real, beams.e_theta.imag, beams.e_phi.real, beams.e_phi.imag)
        arrays |= dict(zip(FIELDS, parts, strict=True))
    else:
        arrays[POWER] = beams.products
    if grid:
        arrays["theta_deg"] = np.degrees(beams.directions.theta)
        n = beams.directions.n_phi
        arrays["phi_deg"] = 360.0 * np.arange(n) / n
    said = {"format": formats.BEAMS, "absolute": int(beams.absolute)}
    if not fields:
        said["products"] = ",".join(labels(beams.n_ports))
    with replacing(path) as partial:
        if path.suffix.lower() in (".fits", ".fit"):
            _write_fits(partial, arrays, said)
        else:
            declared = layout(fields=fields, grid=grid).variables
            variables = {name: (declared[name].dims, one) for name, one in arrays.items()}
            xr.Dataset(variables, attrs=said).to_netcdf(partial, engine="h5netcdf")
    return path


def _write_fits(path: Path, arrays: dict[str, np.ndarray], said: dict[str, object]) -> None:
    hdus = fits.HDUList([fits.PrimaryHDU()])
    for key, value in said.items():
        hdus[0].header[key.upper()] = value
    for name, array in arrays.items():
        hdus.append(fits.ImageHDU(np.ascontiguousarray(array), name=name))
    hdus.writeto(path)


def _in_order(beams: np.ndarray, products: str) -> np.ndarray:
    """Product beams in the package's order."""
    names = [name.strip() for name in products.split(",")]
    expected = labels(round(np.sqrt(beams.shape[1])))
    if len(names) != beams.shape[1] or sorted(names) != sorted(expected):
        raise InputError(
            f"products is {products}, expected the names of its {beams.shape[1]} product beams: "
            f"{', '.join(expected)}"
        )
    return beams[:, [names.index(name) for name in expected]]
