"""Sky maps from files: ULSA's HDF5 and HEALPix FITS."""

from __future__ import annotations

import warnings
from pathlib import Path

import h5py
import healpy
import numpy as np
from astropy import units as u
from astropy.io import fits
from jaxtyping import Float

from lusee_bayes.checks import InputError, nearest, require_finite
from lusee_bayes.fits_images import is_fits, opened

ULSA_DATASET = "smooth_absorb"


def read_map(path: str | Path, *, dataset: str | None = None) -> Float[np.ndarray, " pixels"]:
    """A HEALPix map in RING order, Galactic coordinates and K, as float64.

    HDF5 (ULSA): ``dataset``, by default ``smooth_absorb``. FITS: the first map of the first binary
    table, whose header must say ORDERING = RING; COORDSYS, where present, must be Galactic and
    the unit a temperature. InputError says what is wrong and how to mend it.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"no sky map at '{path}'; check sky.file")
    hdf5 = h5py.is_hdf5(path)
    pixels = _read_hdf5(path, dataset or ULSA_DATASET) if hdf5 else _read_fits(path)
    if pixels.ndim != 1 or not healpy.isnpixok(pixels.size):
        raise InputError(f"{path}: {pixels.shape} values are not a HEALPix map of 12 NSIDE^2")
    require_finite(f"{path}: the map", pixels)
    unseen = pixels == healpy.UNSEEN
    if unseen.any():
        raise InputError(
            f"{path}: {int(unseen.sum())} of {pixels.size} pixels are UNSEEN; give a full-sky map"
        )
    return pixels


def _read_hdf5(path: Path, dataset: str) -> np.ndarray:
    with h5py.File(path) as file:
        names = [name for name, item in file.items() if isinstance(item, h5py.Dataset)]
        if dataset not in names:
            raise InputError(
                f"{path} has no dataset '{dataset}' (it has {', '.join(sorted(names))}); "
                f"{nearest(dataset, names)} Set sky.dataset"
            )
        return file[dataset][...].astype(np.float64)


def _read_fits(path: Path) -> np.ndarray:
    if not is_fits(path):
        raise InputError(
            f"{path} is neither HDF5 nor FITS; give an ULSA HDF5 or a HEALPix FITS map"
        )
    with opened(path) as hdus:
        tables = [hdu for hdu in hdus if isinstance(hdu, fits.BinTableHDU)]
        if not tables:
            raise InputError(
                f"{path} has no binary table; expected a HEALPix FITS map (or ULSA HDF5)"
            )
        header, column = tables[0].header, tables[0].columns[0]
        values = np.array(tables[0].data.field(0), dtype=np.float64).ravel()
    ordering = str(header.get("ORDERING", "absent")).strip().upper()
    if ordering != "RING":
        raise InputError(
            f"{path}: ORDERING is {ordering}, expected RING; write it anew with "
            "healpy.write_map(..., nest=False), after healpy.reorder(m, n2r=True) if it is NESTED"
        )
    frame = str(header.get("COORDSYS", "G")).strip().upper()
    if frame not in ("G", "GALACTIC"):
        raise InputError(
            f"{path}: COORDSYS is {frame}, expected G (Galactic); rotate the map with "
            f"healpy.Rotator(coord=['{frame[:1]}', 'G'])"
        )
    return values * _kelvin(path, column.unit)


def _kelvin(path: Path, unit: str | None) -> float:
    """Factor from the file's unit to K; a map without unit is taken to be in K."""
    if not unit:
        return 1.0
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", u.UnitsWarning)
            return u.Unit(unit, format="fits").to(u.K)
    except (ValueError, u.UnitConversionError) as error:
        raise InputError(
            f"{path}: the map's unit is '{unit}', expected a temperature (K); convert it first"
        ) from error
