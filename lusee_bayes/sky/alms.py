"""Skies as spherical-harmonic coefficients in healpy's packing: its FITS tables, and .npz files.

FITS, as healpy.write_alm makes it: columns index = ell^2 + ell + m + 1, real, imag, for m >= 0.
NumPy's .npz: ``alm`` (frequency, coefficient) and ``freq`` in MHz. Galactic, K.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from astropy.io import fits
from jaxtyping import Float

from lusee_bayes.core.arrays import Array
from lusee_bayes.core.checks import require_finite
from lusee_bayes.core.errors import InputError
from lusee_bayes.core.files import replacing, user_path
from lusee_bayes.core.formats import is_fits, opened
from lusee_bayes.core.harmonics import from_healpy, lmax_of, n_modes, to_healpy
from lusee_bayes.core.layouts import Layout, Variable
from lusee_bayes.core.lazy import healpy
from lusee_bayes.core.reading import read_arrays
from lusee_bayes.sky.files import SkyFile

COLUMNS = ("index", "real", "imag")
TABLE = Layout(
    "coefficients, as healpy.write_alm writes them",
    {
        "index": Variable(("coefficient",), "integer", low=1.0),
        "real": Variable(("coefficient",), unit="K"),
        "imag": Variable(("coefficient",), unit="K"),
    },
)
NPZ = Layout(
    "coefficients: freq (MHz) and alm (frequency, coefficient)",
    {
        "freq": Variable(("freq",), low=0.0, unit="MHz"),
        "alm": Variable(("freq", "coefficient"), "complex"),
    },
)
# far above what a run can hold
LARGEST_LMAX = 4096


@dataclass(frozen=True)
class SkyAlms(SkyFile):
    """Coefficients of one or several frequencies.

    Attributes
    ----------
    path : str
        The file, for messages.
    frequencies_mhz : (frequencies,) array or None
        None where the file does not say its frequency.
    modes : (frequencies, modes) array
        Real packed coefficients, Galactic, in K.
    """

    path: str
    frequencies_mhz: Float[np.ndarray, " frequencies"] | None
    modes: Float[np.ndarray, "frequencies modes"]

    @classmethod
    def recognises(cls, path: Path) -> bool:
        if path.suffix == ".npz":
            return True
        if not is_fits(path):
            return False
        with opened(path) as hdus:
            tables = [hdu for hdu in hdus if isinstance(hdu, fits.BinTableHDU)]
            names = tables[0].columns.names if tables else []
            return set(COLUMNS) <= {name.lower() for name in names}

    @classmethod
    def read(cls, path: str | Path, dataset: str | None = None) -> SkyAlms:
        """Read a file of coefficients.

        Raises
        ------
        InputError
            For a file that cannot be read, arrays that are missing or do not fit, coefficients
            that do not fill an lmax, and numbers that are not finite.
        """
        path = user_path(path)
        frequencies, alm = _read_npz(path) if path.suffix == ".npz" else (None, _read_fits(path))
        require_finite(f"{path}: the coefficients", np.stack([alm.real, alm.imag]))
        return cls(str(path), frequencies, from_healpy(np.atleast_2d(alm)))

    @property
    def lmax(self) -> int:
        """Highest ell of the coefficients."""
        return lmax_of(self.modes.shape[1])

    def modes_at(self, frequency_mhz: float, lmax: int) -> Float[np.ndarray, " modes"]:
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

    def summary(self) -> tuple[str, ...]:
        known, means = self.frequencies_mhz, self.modes[:, 0] / np.sqrt(4.0 * np.pi)
        skies = "one sky" if len(means) == 1 else f"{len(means)} skies"
        frequencies = "" if known is None else f", {', '.join(f'{f:g}' for f in known)} MHz"
        levels = f"{means[0]:.6g}" if len(means) == 1 else f"{means[0]:.6g} to {means[-1]:.6g}"
        return (
            f"coefficients of {skies} up to ell = {self.lmax}{frequencies}",
            f"mean temperature {levels} K",
        )


def write_alms(path: str | Path, modes: Float[Array, " modes"], header: dict[str, object]) -> Path:
    """Write coefficients as healpy.write_alm does, in float64.

    Parameters
    ----------
    path : str or Path
        The file to write; it is replaced in one step.
    modes : (modes,) array
        Real packed coefficients, Galactic, in K.
    header : dict
        Further cards of the table's header.

    Returns
    -------
    Path
        The file.
    """
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
    return user_path(path)


def _read_npz(path: Path) -> tuple[np.ndarray, np.ndarray]:
    found = read_arrays(path, NPZ, "check sky.file").arrays
    alm = found["alm"]
    if healpy.Alm.getlmax(alm.shape[1]) < 0:
        raise InputError(
            f"{path}: alm has {alm.shape[1]} coefficients, expected (lmax + 1) (lmax + 2) / 2"
        )
    return found["freq"], alm


def _read_fits(path: Path) -> np.ndarray:
    with opened(path, "coefficients") as hdus:
        table = next(hdu for hdu in hdus if isinstance(hdu, fits.BinTableHDU))
        columns = {name: table.data.field(name) for name in COLUMNS}
        units = {f"{one.name.lower()}.units": one.unit for one in table.columns}
        found = TABLE.checked(path, columns, units).arrays
    index, real, imag = (found[name] for name in COLUMNS)
    # what does not fit into memory, or is written twice, fills no lmax either
    if index.max() > LARGEST_LMAX**2 or len(set(index.tolist())) < len(index):
        raise InputError(
            f"{path}: index must be ell^2 + ell + m + 1, each once, ell <= {LARGEST_LMAX}"
        )
    ell = np.floor(np.sqrt(index - 1.0) + 1e-9).astype(int)
    m = index - 1 - ell**2 - ell
    lmax = int(ell.max())
    alm = np.full(healpy.Alm.getsize(lmax), np.nan + 0j)
    if (m < 0).any() or (m > ell).any():
        raise InputError(f"{path}: index must be ell^2 + ell + m + 1 with 0 <= m <= ell")
    alm[healpy.Alm.getidx(lmax, ell, m)] = real + 1j * imag
    if np.isnan(alm).any():
        raise InputError(
            f"{path}: {int(np.isnan(alm).sum())} coefficients up to ell = {lmax} are missing or "
            "not finite; write all m up to ell"
        )
    return alm
