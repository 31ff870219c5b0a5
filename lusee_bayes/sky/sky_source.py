"""A sky at one frequency, and its sources: the embedded Galaxy, or a file.

Skies are real harmonic coefficients in Galactic coordinates, in K. Files have one of three layouts.

**Maps** are ULSA's HDF5 or HEALPix FITS.

**Coefficients** are in healpy's packing. FITS, as healpy.write_alm writes it: columns
index = ell^2 + ell + m + 1, real, imag, for m >= 0. NumPy's .npz: ``alm`` (frequency, coefficient)
and ``freq`` in MHz. Galactic, K.

**Cubes** are maps of many frequencies, in the layout of luseepy's ULSA file, which lowsky also
writes. FITS: one primary image (frequency, pixel) of HEALPix maps, RING, Galactic, K; the header
has FREQ_START, FREQ_END and FREQ_STEP in MHz. The file does not state its frame and order.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import equinox as eqx
import h5py
import numpy as np
from astropy.io import fits
from jaxtyping import Bool, Float

from lusee_bayes.core import checks, files, harmonics
from lusee_bayes.core.arrays import Array, Modes, Pixels
from lusee_bayes.core.errors import InputError, nearest
from lusee_bayes.core.formats import has_words, image_names, is_fits, opened, require_readable_hdf5
from lusee_bayes.core.layouts import Attribute, Layout, Variable
from lusee_bayes.core.lazy import healpy
from lusee_bayes.core.reading import naming, read_arrays, reading, require_file
from lusee_bayes.sky.galaxy import BRIGHT_SOURCES, PointSource, galaxy_map


class Sky(checks.Described, eqx.Module):
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
        checks.require_array("the sky", self.modes)
        harmonics.lmax_of(self.modes.shape[-1])

    def description(self) -> tuple[str, ...]:
        mean = checks.number(self.modes[0] / np.sqrt(4.0 * np.pi))
        return (
            f"{self.name} at {self.frequency_mhz:g} MHz, lmax = {self.lmax}",
            f"{self.modes.shape[-1]} real coefficients, Galactic, in K; mean {mean} K",
        )

    @property
    def lmax(self) -> int:
        """Highest ell of the coefficients."""
        return harmonics.lmax_of(self.modes.shape[-1])

    @property
    def mean_temperature(self) -> float:
        """Sky average in K."""
        return float(self.modes[0]) / np.sqrt(4.0 * np.pi)

    def spectrum(self) -> Float[Array, " ells"]:
        """C_ell in K^2, mean not subtracted."""
        return harmonics.power_spectrum(self.modes)


class SkyFile(checks.Described, ABC):
    """The content of one file of sky maps or coefficients, whole and checked.

    A new layout of files is a subclass, and one entry in
    :data:`SKY_READERS`.
    """

    @classmethod
    @abstractmethod
    def recognises(cls, path: Path) -> bool:
        """Return whether an existing file has this layout.

        Raises
        ------
        InputError
            If this needs more of the file than can be read.
        """

    @classmethod
    @abstractmethod
    def read(cls, path: str | Path, dataset: str | None = None) -> SkyFile:
        """Read a file of this layout.

        Parameters
        ----------
        path : str or Path
            The file.
        dataset : str, optional
            Data set to read, for layouts with several.

        Raises
        ------
        InputError
            If the file cannot be used; the message states the error and its remedy.
        """

    @abstractmethod
    def modes_at(self, frequency_mhz: float, lmax: int) -> Float[np.ndarray, " modes"]:
        """Compute the sky's coefficients at a frequency.

        Parameters
        ----------
        frequency_mhz : float
            Frequency in MHz. Layouts without a frequency return the same sky at any frequency.
        lmax : int
            Highest ell.

        Returns
        -------
        (modes,) array
            Real packed coefficients, Galactic, in K.

        Raises
        ------
        InputError
            If the file has no sky at this frequency, or not up to this ell.
        """


def modes_of_map(path: str | Path, pixels: Pixels, lmax: int) -> Modes:
    """Coefficients of a file's map; an InputError names the file."""
    with naming(path):
        return harmonics.map_to_modes(pixels, lmax)


ULSA_DATASET = "smooth_absorb"
# healpy's value of pixels without data; importing healpy takes a second
UNSEEN = -1.6375e30


@dataclass(frozen=True, repr=False)
class SkyMap(SkyFile):
    """One HEALPix map of unstated frequency.

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

        The FITS map is the first column of the first binary table. Its header must state
        ORDERING = RING; COORDSYS, if present, must be Galactic, and the unit a temperature.

        Parameters
        ----------
        path : str or Path
            The file.
        dataset : str, optional
            Data set of an HDF5 file, by default ULSA's ``smooth_absorb``.

        Raises
        ------
        InputError
            If the file cannot be used; the message states the error and its remedy.
        """
        path = files.user_path(path)
        hdf5 = h5py.is_hdf5(path)
        pixels = _read_hdf5(path, dataset or ULSA_DATASET) if hdf5 else _read_map(path)
        _require_healpix(path, pixels.size)
        return cls(str(path), pixels)

    @property
    def unseen(self) -> Bool[np.ndarray, " pixels"]:
        """Which pixels have no data."""
        return _is_unseen(self.pixels)

    def modes_at(self, frequency_mhz: float, lmax: int) -> Float[np.ndarray, " modes"]:
        if self.unseen.any():
            raise InputError(
                f"{self.path}: {int(self.unseen.sum())} of {self.pixels.size} pixels are UNSEEN; "
                "give a full-sky map, or use it as one of prior.surveys"
            )
        return modes_of_map(self.path, self.pixels, lmax)

    def description(self) -> tuple[str, ...]:
        pixels, n = self.pixels[~self.unseen], self.pixels.size
        gaps = f", {n - pixels.size} pixels UNSEEN" if pixels.size < n else ""
        return (
            f"HEALPix sky map, NSIDE {round((n / 12) ** 0.5)}, RING, Galactic{gaps}",
            f"mean {pixels.mean():.6g} K, from {pixels.min():.4g} to {pixels.max():.4g} K",
        )


def _require_healpix(path: str | Path, n_pixels: int) -> None:
    if not n_pixels or n_pixels != 12 * round((n_pixels / 12) ** 0.5) ** 2:
        raise InputError(f"{path} has {n_pixels} values, expected 12 NSIDE^2 of a HEALPix map")


def _checked_pixels(path: Path, name: str, given: Any, unit: Any) -> np.ndarray:
    """In K, and UNSEEN where a file, in its unit and precision, has no data."""
    layout = Layout("a HEALPix sky map", {name: Variable(("pixel",), unit="K")})
    values = layout.checked(path, {name: given}, {f"{name}.units": unit}).arrays[name]
    return np.where(_is_unseen(np.asarray(given)), UNSEEN, values)


def _read_hdf5(path: Path, dataset: str) -> np.ndarray:
    require_readable_hdf5(path)
    with reading(path, "a sky map in HDF5"), h5py.File(path) as file:
        names = [name for name, item in file.items() if isinstance(item, h5py.Dataset)]
        if dataset not in names:
            raise InputError(
                f"{path} has no dataset '{dataset}', as sky.dataset says (it has "
                f"{', '.join(sorted(names))}); {nearest(dataset, names)}"
            )
        return _checked_pixels(path, dataset, file[dataset], file[dataset].attrs.get("units"))


def _is_unseen(pixels: np.ndarray) -> Bool[np.ndarray, "..."]:
    # in the file's unit and precision
    return np.isclose(pixels, UNSEEN, rtol=1e-6)


def _read_map(path: Path) -> np.ndarray:
    with opened(path) as hdus:
        if not (tables := [hdu for hdu in hdus if isinstance(hdu, fits.BinTableHDU)]):
            wrong = f"{path} has no binary table; expected a HEALPix FITS map (or ULSA HDF5)"
            raise InputError(wrong)
        header = tables[0].header
        listed = str(header.get("INDXSCHM")).strip().upper() == "EXPLICIT"
        column = tables[0].columns[int(listed)]
        # healpy writes rows of 1024 pixels
        given = np.ravel(tables[0].data.field(int(listed)))
        values = _checked_pixels(path, column.name, given, column.unit)
        if listed:  # of some pixels only
            some = values
            values = np.full(12 * int(header["NSIDE"]) ** 2, UNSEEN)
            values[np.ravel(tables[0].data.field(0))] = some
    _require_ring(path, header, "absent")
    return values


def _require_ring(path: str | Path, header: Mapping[str, Any], ordering: str) -> None:
    """Check that pixels are RING and Galactic; ``ordering``: what a header without it means."""
    ordering = str(header.get("ORDERING", ordering)).strip().upper()
    if ordering != "RING":
        raise InputError(
            f"{path}: ORDERING is {ordering}, expected RING; rewrite it with healpy.write_map(..., "
            "nest=False), after healpy.reorder(m, n2r=True) if it is NESTED"
        )
    frame = str(header.get("COORDSYS", "G")).strip().upper()
    if frame not in ("G", "GALACTIC"):
        raise InputError(
            f"{path}: COORDSYS is {frame}, expected G (Galactic); rotate the map with "
            f"healpy.Rotator(coord=['{frame[:1]}', 'G'])"
        )


COLUMNS = ("index", "real", "imag")
TABLE_COLUMNS = {
    "index": Variable(("coefficient",), "integer", low=1.0),
    **dict.fromkeys(COLUMNS[1:], Variable(("coefficient",), unit="K")),
}
TABLE = Layout("coefficients, as healpy.write_alm writes them", TABLE_COLUMNS)
NPZ_ARRAYS = {
    "freq": Variable(("freq",), low=0.0, unit="MHz"),
    "alm": Variable(("freq", "coefficient"), "complex"),
}
NPZ = Layout("coefficients: freq (MHz) and alm (frequency, coefficient)", NPZ_ARRAYS)


@dataclass(frozen=True, repr=False)
class SkyAlms(SkyFile):
    """Coefficients of one or several frequencies.

    Attributes
    ----------
    path : str
        The file, for messages.
    frequencies_mhz : (frequencies,) array or None
        None if the file does not state its frequency.
    modes : (frequencies, modes) array
        Real packed coefficients, Galactic, in K.
    """

    path: str
    frequencies_mhz: Float[np.ndarray, " frequencies"] | None
    modes: Float[np.ndarray, "frequencies modes"]

    @classmethod
    def recognises(cls, path: Path) -> bool:
        is_npz = path.suffix == ".npz"
        if is_npz or not is_fits(path):
            return is_npz
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
            For a file that cannot be read, arrays that are missing or do not match, coefficients
            that do not fill an lmax, and numbers that are not finite.
        """
        path = files.user_path(path)
        if path.suffix == ".npz":
            arrays = read_arrays(path, NPZ, "check sky.file").arrays
            frequencies, alm = arrays["freq"], arrays["alm"]
            if healpy.Alm.getlmax(alm.shape[1]) < 0:
                wrong = f"{path}: alm has {alm.shape[1]} values, expected (lmax + 1) (lmax + 2) / 2"
                raise InputError(wrong)
        else:
            frequencies, alm = None, _read_alm_fits(path)
        return cls(str(path), frequencies, harmonics.from_healpy(np.atleast_2d(alm)))

    @property
    def lmax(self) -> int:
        """Highest ell of the coefficients."""
        return harmonics.lmax_of(self.modes.shape[1])

    def modes_at(self, frequency_mhz: float, lmax: int) -> Float[np.ndarray, " modes"]:
        if lmax > self.lmax:
            raise InputError(
                f"{self.path} has coefficients up to ell = {self.lmax}, expected up to {lmax}; "
                "lower lmax, or noise.above_lmax.treatment=ignored if the sky ends there"
            )
        mhz, channel = self.frequencies_mhz, 0
        if mhz is not None:
            channel = int(np.argmin(np.abs(mhz - frequency_mhz)))
            if not np.isclose(mhz[channel], frequency_mhz, rtol=1e-9):
                raise InputError(
                    f"{self.path} has no coefficients at {frequency_mhz:g} MHz (it has "
                    f"{', '.join(f'{f:g}' for f in mhz)}); read it at one of those: "
                    "sky.file_frequency_mhz (and sky.spectral_index), or a survey's frequency_mhz"
                )
        return self.modes[channel, : harmonics.n_modes(lmax)]

    def description(self) -> tuple[str, ...]:
        mhz, means = self.frequencies_mhz, self.modes[:, 0] / np.sqrt(4.0 * np.pi)
        skies = "one sky" if len(means) == 1 else f"{len(means)} skies"
        frequencies = "" if mhz is None else f", {', '.join(f'{f:g}' for f in mhz)} MHz"
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
    with files.replacing(path) as partial:
        healpy.write_alm(partial, harmonics.to_healpy(modes), out_dtype=np.float64)
        with fits.open(partial, mode="update") as hdus:
            hdus[1].header.update({"TUNIT2": "K", "TUNIT3": "K", "EXTNAME": "ALM"} | header)
    return files.user_path(path)


def _read_alm_fits(path: Path) -> np.ndarray:
    with opened(path, "coefficients") as hdus:
        table = next(hdu for hdu in hdus if isinstance(hdu, fits.BinTableHDU))
        columns = {name: table.data.field(name) for name in COLUMNS}
        units = {f"{one.name.lower()}.units": one.unit for one in table.columns}
        arrays = TABLE.checked(path, columns, units).arrays
    index, real, imag = (arrays[name] for name in COLUMNS)
    lmax = min(int(np.sqrt(index.max() - 1.0)), harmonics.LARGEST_LMAX)
    ell, m = healpy.Alm.getlm(lmax)
    expected = ell**2 + ell + m + 1
    if not np.isin(index, expected).all() or len(np.unique(index)) < len(index):
        raise InputError(
            f"{path}: index must be ell^2 + ell + m + 1, each once, with 0 <= m <= ell <= "
            f"{harmonics.LARGEST_LMAX}"
        )
    if missing := len(expected) - len(index):
        raise InputError(
            f"{path}: {missing} coefficients up to ell = {lmax} are missing; write all m up to ell"
        )
    alm = np.empty(len(index), dtype=np.complex128)
    alm[np.argsort(expected)] = (real + 1j * imag)[np.argsort(index)]
    return alm


STEPS = ("FREQ_START", "FREQ_END", "FREQ_STEP")
# the table of frequencies in cubes of maps that the package writes
LISTED = "FREQUENCIES"
CUBE = Layout(
    "sky maps of many frequencies: an image (frequency, pixel)",
    {"maps": Variable(("frequency", "pixel"), unit="K")},
    dict.fromkeys(STEPS[:2], Attribute(low=0.0, unit="MHz"))
    | {STEPS[2]: Attribute(low=1e-6, unit="MHz")},
)


@dataclass(frozen=True, repr=False)
class SkyCube(SkyFile):
    """Maps of several frequencies.

    Attributes
    ----------
    path : str
        The file, for messages.
    frequencies_mhz : (frequencies,) array
        Increasing.
    pixels : (frequencies, pixels) array
        HEALPix RING, Galactic, in K.
    """

    path: str
    frequencies_mhz: Float[np.ndarray, " frequencies"]
    pixels: Float[np.ndarray, "frequencies pixels"]

    @classmethod
    def recognises(cls, path: Path) -> bool:
        return is_fits(path) and (LISTED.lower() in image_names(path) or has_words(path, STEPS))

    @classmethod
    def read(cls, path: str | Path, dataset: str | None = None) -> SkyCube:
        """Read a file of maps of many frequencies.

        Raises
        ------
        InputError
            For a truncated file, steps of frequency that do not match the maps, maps that are not
            HEALPix, and numbers that are not finite.
        """
        with opened(path, "sky maps of many frequencies") as hdus:
            images = {} if hdus[0].data is None else {"maps": hdus[0].data}
            header = dict(hdus[0].header)
            mhz = hdus[LISTED].data.field(0).astype(float) if LISTED in hdus else None
            if mhz is not None:  # in any steps
                header |= dict(zip(STEPS, (mhz[0], mhz[-1], 1.0), strict=True))
            cube = CUBE.checked(path, images, header | {"maps.units": header.get("BUNIT")})
        _require_ring(path, header, "RING")
        start, end, step = (cube.values[key] for key in STEPS)
        pixels = cube.arrays["maps"]
        mhz = start + step * np.arange(round((end - start) / step) + 1) if mhz is None else mhz
        if len(pixels) != len(mhz):
            raise InputError(
                f"{path}: the image has shape {pixels.shape}, expected {len(mhz)} maps for "
                f"{start:g} to {end:g} MHz"
            )
        _require_healpix(path, pixels.shape[1])
        return cls(str(path), mhz, pixels)

    def map_at(self, frequency_mhz: float) -> Float[np.ndarray, " pixels"]:
        """Return the map at a frequency; between two maps, each pixel follows a power law.

        Parameters
        ----------
        frequency_mhz : float
            Frequency in MHz.

        Returns
        -------
        (pixels,) array
            HEALPix RING, Galactic, in K.

        Raises
        ------
        InputError
            Outside the file's frequencies, or if a pixel between two frequencies is not positive in
            both.
        """
        mhz = self.frequencies_mhz
        if not mhz[0] <= frequency_mhz <= mhz[-1]:
            raise InputError(
                f"{self.path} has maps from {mhz[0]:g} to {mhz[-1]:g} MHz, not at "
                f"{frequency_mhz:g}; read it at one of those: sky.file_frequency_mhz (and "
                "sky.spectral_index), or a survey's frequency_mhz"
            )
        above = int(np.searchsorted(mhz, frequency_mhz))
        if (gaps := _is_unseen(self.pixels[max(above - 1, 0) : above + 1])).any():
            raise InputError(f"{self.path}: {gaps.sum()} pixels are UNSEEN; give full-sky maps")
        if mhz[above] == frequency_mhz:
            return self.pixels[above]
        low, high = self.pixels[above - 1], self.pixels[above]
        if not ((low > 0) & (high > 0)).all():
            raise InputError(
                f"{self.path} has pixels that are not positive at {mhz[above - 1]:g} or "
                f"{mhz[above]:g} MHz, so that no power law is between them; use a frequency of it"
            )
        share = np.log(frequency_mhz / mhz[above - 1]) / np.log(mhz[above] / mhz[above - 1])
        return low * (high / low) ** share

    def modes_at(self, frequency_mhz: float, lmax: int) -> Float[np.ndarray, " modes"]:
        return modes_of_map(self.path, self.map_at(frequency_mhz), lmax)

    def description(self) -> tuple[str, ...]:
        mhz, pixels = self.frequencies_mhz, self.pixels
        return (
            f"{len(pixels)} HEALPix sky maps, NSIDE {healpy.npix2nside(pixels.shape[1])}, assumed "
            "RING and Galactic",
            f"{mhz[0]:g} to {mhz[-1]:g} MHz, means {pixels[0].mean():.6g} to "
            f"{pixels[-1].mean():.6g} K, smallest pixel {pixels.min():.4g} K",
        )


# the first that recognises a file reads it; any other FITS file is a map
SKY_READERS: tuple[type[SkyFile], ...] = (SkyAlms, SkyCube, SkyMap)


class SkySource(ABC):
    """A sky at many frequencies."""

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


Sources = tuple[PointSource, ...]


@lru_cache(maxsize=4)
def _galaxy_modes(frequency_mhz: float, seed: int | None, lmax: int) -> np.ndarray:
    """Compute the diffuse sky's coefficients, read-only: variations of a scenario share one sky."""
    checks.require_whole("lmax", lmax, 0, 383)
    nside = 64 if lmax <= 95 else 128
    modes = harmonics.map_to_modes(galaxy_map(frequency_mhz, nside=nside, seed=seed), lmax)
    modes.flags.writeable = False
    return modes


def read_sky_file(path: str | Path, dataset: str | None = None) -> SkyFile:
    """Read a file of skies, in any known layout.

    Parameters
    ----------
    path : str or Path
        The file.
    dataset : str, optional
        Data set to read, for layouts with several.

    Raises
    ------
    InputError
        If there is no such file, if no reader recognises it, or if it cannot be used.
    """
    path = require_file(path, "sky map", "check sky.file")
    for reader in SKY_READERS:
        if reader.recognises(path):
            return reader.read(path, dataset)
    why = f"{path} is neither HDF5, FITS nor .npz; give an ULSA file, a HEALPix map or coefficients"
    raise InputError(why)


def galaxy_sky(
    frequency_mhz: float, lmax: int = 47, *, seed: int | None = 1, sources: Sources = BRIGHT_SOURCES
) -> Sky:
    """Compute the embedded sky: diffuse Galaxy, extragalactic background and bright sources.

    Parameters
    ----------
    frequency_mhz : float
    lmax : int
    seed : int or None
        Seed of the random structure (:class:`.Structures`), which is the same at all frequencies;
        None for no structure.
    sources : tuple of PointSource
        Sources to add to the diffuse sky.

    Raises
    ------
    InputError
        Outside 1 to 50 MHz.
    """
    modes = _galaxy_modes(float(frequency_mhz), seed, lmax)
    for source in sources:
        modes = modes + source.modes(frequency_mhz, lmax)
    return Sky(modes, float(frequency_mhz), "embedded Galaxy")


def sky_from_file(
    path: str | Path,
    frequency_mhz: float,
    lmax: int = 47,
    *,
    dataset: str | None = None,
    file_frequency_mhz: float | None = None,
    spectral_index: float = -2.5,
) -> Sky:
    """Read the sky from a file in one of the layouts of :data:`SKY_READERS`.

    Parameters
    ----------
    path : str or Path
        The file.
    frequency_mhz : float
    lmax : int
    dataset : str, optional
        Data set to read, for layouts with several.
    file_frequency_mhz : float, optional
        Frequency in MHz for which the file was made, or at which it is read. The sky is then scaled
        by (frequency / file frequency)^spectral_index. By default the file is read at
        ``frequency_mhz``.
    spectral_index : float
        Index of that power law.

    Raises
    ------
    InputError
        For files that are missing, unreadable, in another order or frame, contain NaN, or have
        other frequencies; if ``file_frequency_mhz`` is not positive.
    """
    read_at = frequency_mhz if file_frequency_mhz is None else file_frequency_mhz
    if not read_at > 0:
        raise InputError(f"file_frequency_mhz must be positive, got {read_at}")
    modes = read_sky_file(path, dataset).modes_at(float(read_at), lmax)
    scale = (frequency_mhz / read_at) ** spectral_index
    return Sky(scale * modes, float(frequency_mhz), Path(path).name)
