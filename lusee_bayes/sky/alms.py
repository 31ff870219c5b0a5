"""Skies as spherical-harmonic coefficients in healpy's packing: its FITS tables, and .npz files.

FITS, as healpy.write_alm makes it: columns index = ell^2 + ell + m + 1, real, imag, for m >= 0.
NumPy's .npz: ``alm`` (frequency, coefficient) and ``freq`` in MHz. Galactic, K.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import healpy
import numpy as np
from astropy.io import fits
from jaxtyping import Float

from lusee_bayes.checks import AnyArray, InputError, require_finite
from lusee_bayes.fits_images import opened
from lusee_bayes.harmonics import from_healpy, lmax_of, n_modes, to_healpy
from lusee_bayes.staging import replacing

COLUMNS = ("index", "real", "imag")


@dataclass(frozen=True)
class SkyAlms:
    """Coefficients of one or several frequencies.

    modes : (frequencies, modes) real packed; frequencies_mhz : None where the file does not say
    """

    path: str
    frequencies_mhz: Float[np.ndarray, " frequencies"] | None
    modes: Float[np.ndarray, "frequencies modes"]

    @property
    def lmax(self) -> int:
        """Highest ell of the coefficients."""
        return lmax_of(self.modes.shape[1])

    def at(self, frequency_mhz: float, lmax: int) -> Float[np.ndarray, " modes"]:
        """Coefficients up to ``lmax`` at one of the file's frequencies.

        InputError for a frequency or an ell that the file does not have.
        """
        if lmax > self.lmax:
            raise InputError(
                f"{self.path} has coefficients up to ell = {self.lmax}, not up to {lmax}; lower "
                "lmax"
            )
        known, channel = self.frequencies_mhz, 0
        if known is not None:
            channel = int(np.argmin(np.abs(known - frequency_mhz)))
            if not np.isclose(known[channel], frequency_mhz, rtol=1e-9):
                raise InputError(
                    f"{self.path} has no coefficients at {frequency_mhz:g} MHz (it has "
                    f"{', '.join(f'{f:g}' for f in known)}); set sky.file_frequency_mhz to one of "
                    "those, and they are scaled with sky.spectral_index"
                )
        return self.modes[channel, : n_modes(lmax)]


def has_alms(path: Path) -> bool:
    """Whether a file is one of coefficients."""
    if path.suffix == ".npz":
        return True
    with opened(path) as hdus:
        tables = [hdu for hdu in hdus if isinstance(hdu, fits.BinTableHDU)]
        return bool(tables) and set(COLUMNS) <= {name.lower() for name in tables[0].columns.names}


def read_alms(path: str | Path) -> SkyAlms:
    """Read a file of coefficients.

    InputError for a file that cannot be read, arrays that are missing or do not fit, coefficients
    that do not fill an lmax, numbers that are not finite.
    """
    path = Path(path)
    frequencies, alm = _read_npz(path) if path.suffix == ".npz" else (None, _read_fits(path))
    require_finite(f"{path}: the coefficients", np.stack([alm.real, alm.imag]))
    return SkyAlms(str(path), frequencies, from_healpy(np.atleast_2d(alm)))


def write_alms(
    path: str | Path, modes: Float[AnyArray, " modes"], header: dict[str, object]
) -> Path:
    """Write coefficients as healpy.write_alm does, in float64, with ``header`` cards besides."""
    alm = to_healpy(modes)
    lmax = lmax_of(np.shape(modes)[-1])
    ell, m = healpy.Alm.getlm(lmax)
    values = (ell**2 + ell + m + 1, alm.real, alm.imag)
    formats = ("J", "D", "D")
    table = fits.BinTableHDU.from_columns(
        [
            fits.Column(name, format_, array=value, unit=None if name == "index" else "K")
            for name, format_, value in zip(COLUMNS, formats, values, strict=True)
        ],
        name="ALM",
    )
    table.header["MAX-LPOL"] = (lmax, "highest ell")
    table.header["MAX-MPOL"] = (lmax, "highest m")
    for key, value in header.items():
        table.header[key] = value
    with replacing(path) as partial:
        fits.HDUList([fits.PrimaryHDU(), table]).writeto(partial)
    return Path(path)


def _read_npz(path: Path) -> tuple[np.ndarray, np.ndarray]:
    try:
        with np.load(path, allow_pickle=False) as file:
            missing = [name for name in ("freq", "alm") if name not in file]
            if missing:
                raise InputError(
                    f"{path} has no array '{missing[0]}' (it has {', '.join(file.files)}); "
                    "expected freq (MHz) and alm (frequency, coefficient)"
                )
            frequencies, alm = file["freq"].astype(np.float64), file["alm"]
    except (OSError, ValueError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{path} cannot be read as NumPy's .npz: {error}") from error
    if alm.ndim != 2 or len(alm) != len(frequencies) or healpy.Alm.getlmax(alm.shape[1]) < 0:
        raise InputError(
            f"{path}: alm has shape {alm.shape}, expected {len(frequencies)} frequencies and "
            "(lmax + 1) (lmax + 2) / 2 coefficients"
        )
    return frequencies, alm.astype(np.complex128)


def _read_fits(path: Path) -> np.ndarray:
    with opened(path) as hdus:
        table = next(hdu for hdu in hdus if isinstance(hdu, fits.BinTableHDU)).data
        index, real, imag = (np.asarray(table[name]).ravel() for name in COLUMNS)
    ell = np.floor(np.sqrt(index - 1.0)).astype(int)
    m = index - 1 - ell**2 - ell
    lmax = int(ell.max())
    alm = np.full(healpy.Alm.getsize(lmax), np.nan + 0j)
    if (m < 0).any() or (m > ell).any():
        raise InputError(f"{path}: index must be ell^2 + ell + m + 1 with 0 <= m <= ell")
    alm[healpy.Alm.getidx(lmax, ell, m)] = real.astype(np.float64) + 1j * imag
    if np.isnan(alm).any():
        raise InputError(
            f"{path}: {int(np.isnan(alm).sum())} coefficients up to ell = {lmax} are missing or "
            "not finite; write all m up to ell"
        )
    return alm
