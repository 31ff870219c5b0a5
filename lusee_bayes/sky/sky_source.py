"""A sky at one frequency, and what can tell it: the embedded Galaxy, or a file.

Skies are real harmonic coefficients in Galactic coordinates, in K.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import equinox as eqx
import numpy as np
from jaxtyping import Float

from lusee_bayes.core.arrays import Array
from lusee_bayes.core.checks import Described, number, require_array, require_whole
from lusee_bayes.core.errors import InputError
from lusee_bayes.core.harmonics import lmax_of, map_to_modes, power_spectrum
from lusee_bayes.core.reading import require_file
from lusee_bayes.sky.galaxy import BRIGHT_SOURCES, PointSource, galaxy_map
from lusee_bayes.sky.sky_files import SkyAlms, SkyCube, SkyFile, SkyMap


class Sky(Described, eqx.Module):
    """Brightness temperature of the whole sky at one frequency.

    Attributes
    ----------
    modes : (modes,) array
        Real packed coefficients, Galactic, in K.
    frequency_mhz : float
        Frequency in MHz.
    name : str
        The sky's origin, such as the name of a file.

    Raises
    ------
    InputError
        If the coefficients are not float64, not finite, or do not fill an lmax.
    """

    modes: Float[Array, " modes"]
    frequency_mhz: float = eqx.field(static=True)
    name: str = eqx.field(static=True, default="sky")

    def __check_init__(self):
        require_array("the sky", self.modes)
        lmax_of(self.modes.shape[-1])

    def description(self) -> tuple[str, ...]:
        mean = number(self.modes[0] / np.sqrt(4.0 * np.pi))
        return (
            f"{self.name} at {self.frequency_mhz:g} MHz, lmax = {self.lmax}",
            f"{self.modes.shape[-1]} real coefficients, Galactic, in K; mean {mean} K",
        )

    @property
    def lmax(self) -> int:
        """Highest ell of the coefficients."""
        return lmax_of(self.modes.shape[-1])

    @property
    def mean_temperature(self) -> float:
        """Sky average in K."""
        return float(self.modes[0]) / np.sqrt(4.0 * np.pi)

    def spectrum(self) -> Float[Array, " ells"]:
        """C_ell in K^2, mean not subtracted."""
        return power_spectrum(self.modes)


# the first that recognises a file reads it: every FITS file that is nothing else is a map
SKY_READERS: tuple[type[SkyFile], ...] = (SkyAlms, SkyCube, SkyMap)


class SkySource(ABC):
    """A sky that is known at many frequencies."""

    @abstractmethod
    def at(self, frequency_mhz: float, lmax: int) -> Sky:
        """Compute the sky at a frequency.

        Parameters
        ----------
        frequency_mhz : float
            Frequency in MHz.
        lmax : int
            Highest ell.

        Raises
        ------
        InputError
            If the source has no sky at this frequency, or not up to this ell.
        """


@lru_cache(maxsize=4)
def _galaxy_modes(frequency_mhz: float, seed: int | None, lmax: int) -> np.ndarray:
    """Compute the diffuse sky's coefficients, read-only: variations of a scenario share one sky."""
    require_whole("lmax", lmax, 0, 383)
    nside = 64 if lmax <= 95 else 128
    modes = map_to_modes(galaxy_map(frequency_mhz, nside=nside, seed=seed), lmax)
    modes.flags.writeable = False
    return modes


@dataclass(frozen=True)
class GalaxySource(SkySource):
    """The embedded sky: diffuse Galaxy, extragalactic background and bright sources.

    Attributes
    ----------
    seed : int or None
        Chooses the random small-scale structure, which is the same at all frequencies; None leaves
        it out.
    sources : tuple of PointSource
        The sources that are added to the diffuse sky.
    """

    seed: int | None = 1
    sources: tuple[PointSource, ...] = BRIGHT_SOURCES

    def at(self, frequency_mhz: float, lmax: int) -> Sky:
        modes = _galaxy_modes(float(frequency_mhz), self.seed, lmax)
        for source in self.sources:
            modes = modes + source.modes(frequency_mhz, lmax)
        return Sky(modes, float(frequency_mhz), "embedded Galaxy")


@dataclass(frozen=True)
class FileSource(SkySource):
    """The sky of a file of one of the layouts in :data:`SKY_READERS`.

    Attributes
    ----------
    path : str or Path
        The file.
    dataset : str, optional
        Which of its data sets to read, for layouts that have several.
    file_frequency_mhz : float, optional
        The frequency in MHz that the file was made for, or at which it is read. The sky is then
        scaled by (frequency / file frequency)^spectral_index. By default the file is read at
        the frequency asked for.
    spectral_index : float
        Index of that power law.

    Raises
    ------
    InputError
        If ``file_frequency_mhz`` is not positive.
    """

    path: str | Path
    dataset: str | None = None
    file_frequency_mhz: float | None = None
    spectral_index: float = -2.5

    def __post_init__(self):
        if self.file_frequency_mhz is not None and not self.file_frequency_mhz > 0:
            raise InputError(f"file_frequency_mhz must be positive, got {self.file_frequency_mhz}")

    def at(self, frequency_mhz: float, lmax: int) -> Sky:
        read_at, scale = float(frequency_mhz), 1.0
        if self.file_frequency_mhz is not None:
            read_at = float(self.file_frequency_mhz)
            scale = (frequency_mhz / read_at) ** self.spectral_index
        modes = read_sky_file(self.path, self.dataset).modes_at(read_at, lmax)
        return Sky(scale * modes, float(frequency_mhz), Path(self.path).name)


def read_sky_file(path: str | Path, dataset: str | None = None) -> SkyFile:
    """Read a file of skies, of whichever layout.

    Parameters
    ----------
    path : str or Path
        The file.
    dataset : str, optional
        Which of its data sets to read, for layouts that have several.

    Raises
    ------
    InputError
        If there is no such file, if no reader recognises it, or if it cannot be used.
    """
    path = require_file(path, "sky map", "check sky.file")
    for reader in SKY_READERS:
        if reader.recognises(path):
            return reader.read(path, dataset)
    raise InputError(
        f"{path} is neither HDF5 nor FITS; give an ULSA HDF5, a HEALPix FITS map, or coefficients "
        "(FITS or .npz)"
    )


def galaxy_sky(
    frequency_mhz: float,
    lmax: int = 47,
    *,
    seed: int = 1,
    sources: tuple[PointSource, ...] = BRIGHT_SOURCES,
) -> Sky:
    """Compute the embedded sky at one frequency; see :class:`GalaxySource`.

    Raises
    ------
    InputError
        Outside 1 to 50 MHz.
    """
    return GalaxySource(seed, sources).at(frequency_mhz, lmax)


def sky_from_file(
    path: str | Path,
    frequency_mhz: float,
    lmax: int = 47,
    *,
    dataset: str | None = None,
    file_frequency_mhz: float | None = None,
    spectral_index: float = -2.5,
) -> Sky:
    """Read the sky of a file at one frequency; see :class:`FileSource`.

    Raises
    ------
    InputError
        For files that are missing, unreadable, in another order or frame, hold NaN, or have
        other frequencies.
    """
    return FileSource(path, dataset, file_frequency_mhz, spectral_index).at(frequency_mhz, lmax)
