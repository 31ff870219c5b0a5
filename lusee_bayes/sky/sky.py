"""A sky at one frequency, as real harmonic coefficients in Galactic coordinates."""

from __future__ import annotations

from pathlib import Path

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from lusee_bayes.checks import InputError, require_finite, require_float64
from lusee_bayes.fits_images import is_fits
from lusee_bayes.harmonics import lmax_of, map_to_modes, power_spectrum, synthesis_matrix
from lusee_bayes.sky.alms import has_alms, read_alms
from lusee_bayes.sky.cubes import is_cube, read_cube
from lusee_bayes.sky.galaxy import galaxy_map
from lusee_bayes.sky.readers import read_map
from lusee_bayes.sky.sources import BRIGHT_SOURCES, PointSource


class Sky(eqx.Module):
    """Brightness temperature of the whole sky.

    modes : (modes,) real packed Galactic coefficients, in K; frequency_mhz; name : where it is from
    """

    modes: Float[Array, " modes"]
    frequency_mhz: float = eqx.field(static=True)
    name: str = eqx.field(static=True, default="sky")

    def __check_init__(self):
        require_float64("the sky", self.modes)
        require_finite("the sky", self.modes)
        lmax_of(self.modes.shape[-1])

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
        return jnp.asarray(power_spectrum(self.modes))


def source_modes(
    source: PointSource, frequency_mhz: float, lmax: int
) -> Float[np.ndarray, " modes"]:
    """Coefficients of a point source: its K sr times the harmonics at its position."""
    l_deg, b_deg = source.galactic()
    direction = synthesis_matrix(
        np.array([np.radians(90.0 - b_deg)]), np.array([np.radians(l_deg)]), lmax
    )
    return source.kelvin_steradian(frequency_mhz) * direction[0]


def galaxy_sky(
    frequency_mhz: float,
    lmax: int = 47,
    *,
    seed: int = 1,
    sources: tuple[PointSource, ...] = BRIGHT_SOURCES,
) -> Sky:
    """The embedded sky: diffuse Galaxy, extragalactic background and bright sources.

    ``seed`` chooses the random small-scale structure, the same at all frequencies. InputError
    outside 1 to 50 MHz.
    """
    nside = 64 if lmax <= 95 else 128
    modes = map_to_modes(galaxy_map(frequency_mhz, nside=nside, seed=seed), lmax)
    for source in sources:
        modes = modes + source_modes(source, frequency_mhz, lmax)
    return Sky(jnp.asarray(modes), float(frequency_mhz), "embedded Galaxy")


def sky_from_file(
    path: str | Path,
    frequency_mhz: float,
    lmax: int = 47,
    *,
    dataset: str | None = None,
    file_frequency_mhz: float | None = None,
    spectral_index: float = -2.5,
) -> Sky:
    """The sky of a file: ULSA HDF5, HEALPix FITS, luseepy's FITS of many maps, coefficients.

    ``file_frequency_mhz``: the frequency that the file was made for (or that is taken out of it),
    if it is not ``frequency_mhz``; the sky is then scaled by (frequency / file frequency)
    ^spectral_index. InputError for files that are missing, unreadable, in another order or frame,
    hold NaN, or have other frequencies.
    """
    path, scale, source_mhz = Path(path), 1.0, float(frequency_mhz)
    if not path.is_file():
        raise InputError(f"no sky map at '{path}'; check sky.file")
    if file_frequency_mhz is not None:
        if not file_frequency_mhz > 0:
            raise InputError(f"file_frequency_mhz must be positive, got {file_frequency_mhz}")
        source_mhz = float(file_frequency_mhz)
        scale = (frequency_mhz / source_mhz) ** spectral_index
    kind = sky_kind(path)
    if kind == "alms":
        modes = read_alms(path).at(source_mhz, lmax)
    else:
        pixels = (
            read_cube(path).at(source_mhz) if kind == "cube" else read_map(path, dataset=dataset)
        )
        try:
            modes = map_to_modes(pixels, lmax)
        except InputError as error:
            raise InputError(f"{path}: {error}") from error
    return Sky(jnp.asarray(scale * modes), float(frequency_mhz), path.name)


def sky_kind(path: Path) -> str:
    """Which layout a file of skies has: ``alms``, ``cube`` or ``map``."""
    if path.suffix == ".npz":
        return "alms"
    if not is_fits(path):
        return "map"
    if is_cube(path):
        return "cube"
    return "alms" if has_alms(path) else "map"
