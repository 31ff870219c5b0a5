"""Sky maps from files: ULSA's HDF5 and HEALPix FITS."""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np
from astropy import units as u
from astropy.io import fits
from jaxtyping import Float

from lusee_bayes.core.errors import InputError, nearest
from lusee_bayes.core.files import user_path
from lusee_bayes.core.formats import is_fits, opened, require_readable_hdf5
from lusee_bayes.core.layouts import Layout, Variable
from lusee_bayes.core.reading import reading
from lusee_bayes.sky.files import SkyFile, modes_of_map

ULSA_DATASET = "smooth_absorb"
# what healpy writes into pixels without a value; healpy itself takes a second to import
UNSEEN = -1.6375e30


@dataclass(frozen=True)
class SkyMap(SkyFile):
    """One HEALPix map, whose frequency the file does not say.

    Attributes
    ----------
    path : str
        The file, for messages.
    pixels : (pixels,) array
        RING, Galactic, in K.
    """

    path: str
    pixels: Float[np.ndarray, " pixels"]

    @classmethod
    def recognises(cls, path: Path) -> bool:
        return h5py.is_hdf5(path) or is_fits(path)

    @classmethod
    def read(cls, path: str | Path, dataset: str | None = None) -> SkyMap:
        """Read a map from HDF5 or FITS.

        The FITS map is the first column of the first binary table. Its header must say
        ORDERING = RING; COORDSYS, where present, must be Galactic, and the unit a temperature.

        Parameters
        ----------
        path : str or Path
            The file.
        dataset : str, optional
            Data set of an HDF5 file, by default ULSA's ``smooth_absorb``.

        Raises
        ------
        InputError
            If the file cannot be used. The message says what is wrong and how to mend it.
        """
        path = user_path(path)
        hdf5 = h5py.is_hdf5(path)
        pixels = _read_hdf5(path, dataset or ULSA_DATASET) if hdf5 else _read_fits(path)
        if not _nside(pixels.size):
            raise InputError(f"{path}: {pixels.size} values are not a HEALPix map of 12 NSIDE^2")
        unseen = pixels == UNSEEN
        if unseen.any():
            raise InputError(
                f"{path}: {int(unseen.sum())} of {pixels.size} pixels are UNSEEN; give a full-sky "
                "map"
            )
        return cls(str(path), pixels)

    def modes_at(self, frequency_mhz: float, lmax: int) -> Float[np.ndarray, " modes"]:
        return modes_of_map(self.path, self.pixels, lmax)

    def summary(self) -> tuple[str, ...]:
        pixels = self.pixels
        return (
            f"HEALPix sky map, NSIDE {_nside(pixels.size)}, RING, Galactic",
            f"mean {pixels.mean():.6g} K, from {pixels.min():.4g} to {pixels.max():.4g} K",
        )


def _nside(n_pixels: int) -> int:
    """NSIDE of 12 NSIDE^2 pixels; 0 if there is none."""
    nside = math.isqrt(n_pixels // 12)
    return nside if 12 * nside**2 == n_pixels else 0


def _layout(name: str) -> Layout:
    return Layout("a HEALPix sky map", {name: Variable(("pixel",), unit="K")})


def _read_hdf5(path: Path, dataset: str) -> np.ndarray:
    require_readable_hdf5(path)
    with reading(path, "a sky map in HDF5"), h5py.File(path) as file:
        names = [name for name, item in file.items() if isinstance(item, h5py.Dataset)]
        if dataset not in names:
            raise InputError(
                f"{path} has no dataset '{dataset}' (it has {', '.join(sorted(names))}); "
                f"{nearest(dataset, names)} Set sky.dataset"
            )
        units = {f"{dataset}.units": file[dataset].attrs.get("units")}
        return _layout(dataset).checked(path, {dataset: file[dataset]}, units).arrays[dataset]


def _read_fits(path: Path) -> np.ndarray:
    with opened(path) as hdus:
        tables = [hdu for hdu in hdus if isinstance(hdu, fits.BinTableHDU)]
        if not tables:
            raise InputError(
                f"{path} has no binary table; expected a HEALPix FITS map (or ULSA HDF5)"
            )
        header, column = tables[0].header, tables[0].columns[0]
        # healpy writes rows of 1024 pixels
        given = {column.name: np.ravel(tables[0].data.field(0))}
        values = _layout(column.name).checked(path, given, {}).arrays[column.name]
    ordering = str(header.get("ORDERING", "absent")).strip().upper()
    if ordering != "RING":
        raise InputError(
            f"{path}: ORDERING is {ordering}, expected RING; write it again with "
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
