"""Sampled beams: on a grid of directions, from another program, in a file.

They are given in directions of a grid or of HEALPix pixels, at some frequencies: either E_theta and
E_phi of every antenna, or the beam of every product. Frame: topocentric at turntable angle zero,
theta from the zenith, phi from East towards North; time goes as exp(+i w t). Nothing is received
from below the horizon.

**Files** of the package are netCDF, or FITS with images of the same names. ``frequency_mhz``
(frequency), increasing; then either ``e_theta_real``, ``e_theta_imag``, ``e_phi_real`` and
``e_phi_imag`` (frequency, antenna, directions), or ``product_beam`` (frequency, product,
directions). Directions are (theta, phi) with ``theta_deg`` (theta) and ``phi_deg`` (phi), or
(pixel): HEALPix, RING. Attributes (in FITS, primary header words): ``format``, ``absolute`` (0
or 1, see :class:`.SampledBeams`), and ``products``, the labels of product beams in their order.

**pyuvdata** is optional (the extra ``uvdata``). A UVBeam of type efield gives, for every feed, the
response to the components of the field along azimuth and zenith angle (``az_za``), or along phi and
theta (``healpix``); azimuth is phi, from East towards North.

:func:`read_beam` reads all of these, and luseepy's files.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from astropy.io import fits
from jaxtyping import Complex, Float, Inexact

from lusee_bayes.core import checks, files, formats
from lusee_bayes.core.errors import InputError
from lusee_bayes.core.layouts import Attribute, Kind, Layout, Variable
from lusee_bayes.core.lazy import healpy, pyuvdata
from lusee_bayes.core.reading import naming, reading, require_file
from lusee_bayes.instrument.beams import fields as beam_fields
from lusee_bayes.instrument.beams.fields import AntennaFields, HemisphereGrid, ProductBeams, on_grid
from lusee_bayes.instrument.beams.luseepy_files import read_response, read_scalar_beam
from lusee_bayes.instrument.beams.source import BeamSource
from lusee_bayes.instrument.products import antennas_of, auto_indices, labels, to_matrix, to_real

# functions in the directions that were sampled, and on a grid
Sampled = Inexact[np.ndarray, "n *directions"]
OnGrid = Inexact[np.ndarray, "n theta phi"]
# tolerance of angles in degrees that are written with few digits, or in single precision
ANGLE_TOLERANCE = 1e-4
# a step of theta this many times as wide as the median is a gap
GAP = 3.0


@dataclass(frozen=True)
class Directions:
    """A grid of theta and phi, or HEALPix pixels, above the horizon.

    Programs differ in whether a direction on the horizon counts as above it. Such directions are
    not used, and the last step to the horizon is extrapolated.

    Attributes
    ----------
    theta : (theta,) array or None
        In radians, below pi / 2; None for HEALPix.
    n_phi : int
        Azimuths 2 pi k / n_phi.
    nside : int
        NSIDE of the pixels; 0 for a grid.
    """

    theta: Float[np.ndarray, " theta"] | None
    n_phi: int
    nside: int = 0

    @classmethod
    def of(cls, theta: Any, phi: Any, n_last: int, path: str) -> Directions:
        """Return the directions along the last axes of arrays.

        Parameters
        ----------
        theta, phi : array or None
            In degrees; see :func:`.sampled_beams`.
        n_last : int
            Length of the last axis: the number of pixels if there are no angles.
        path : str
            For messages.

        Raises
        ------
        InputError
            If angles do not cover the hemisphere, or ``n_last`` pixels are no HEALPix map.
        """
        if theta is None or phi is None:
            if not healpy.isnpixok(n_last):
                raise InputError(
                    f"{path}: {n_last} directions are not the 12 NSIDE^2 pixels of a HEALPix map; "
                    "give theta_deg and phi_deg for a grid"
                )
            return cls(None, 0, healpy.npix2nside(n_last))
        used = theta[theta < 90.0 - ANGLE_TOLERANCE]
        steps = np.diff(theta)[: len(used)]
        step = min(steps.max(initial=0.0), GAP * np.median(steps)) + ANGLE_TOLERANCE
        if len(used) < 4 or max(used[0], 90.0 - used[-1], *steps) > step:
            raise InputError(
                f"{path}: theta_deg runs from {theta[0]:g} to {theta[-1]:g} in {len(theta)} steps, "
                "expected at least four angles, without a gap, from the zenith to the horizon"
            )
        n = len(phi) - int(len(phi) > 1 and abs(phi[-1] - 360.0) < ANGLE_TOLERANCE)
        if np.abs(phi[:n] - 360.0 * np.arange(n) / n).max() > ANGLE_TOLERANCE:
            raise InputError(
                f"{path}: phi_deg runs from {phi[0]:g} to {phi[-1]:g} in {len(phi)} steps, "
                f"expected 360 k / n from East towards North, such as 0, {360.0 / n:g}, ..."
            )
        return cls(np.radians(used), n)

    def above(self, values: np.ndarray, what: str) -> np.ndarray:
        """Select the values in these directions from those in all given directions.

        Raises
        ------
        InputError
            If a value is not finite.
        """
        if self.theta is not None:
            kept = values[..., : len(self.theta), : self.n_phi]
        else:
            # pixels below the horizon become zeros, whatever the file contains
            theta, _ = healpy.pix2ang(self.nside, np.arange(values.shape[-1]))
            kept = np.where(theta < np.pi / 2.0, values, 0.0)
        if (bad := ~np.isfinite(kept)).any():
            wrong = f"{what} contains NaN or infinity in {bad.sum()} of {bad.size} directions"
            raise InputError(wrong)
        return kept

    def quadrature(self, lmax: int) -> HemisphereGrid:
        """Return nodes that resolve both these directions and harmonics up to ``lmax``."""
        rings = 2 * self.nside if self.theta is None else len(self.theta)
        azimuths = 4 * self.nside if self.theta is None else self.n_phi
        return HemisphereGrid.gauss_legendre(2 * max(rings, lmax + 1), max(azimuths, 2 * lmax + 2))

    def scalars_on(self, values: Sampled, grid: HemisphereGrid, turn_deg: float) -> OnGrid:
        """Interpolate functions, turned from East towards North, to a grid."""
        if self.theta is None:
            return beam_fields.from_rings(values, grid.theta, grid.phi - np.radians(turn_deg))
        turned = [on_grid(one.astype(np.complex128), self.theta, grid, turn_deg) for one in values]
        return np.stack(turned) if np.iscomplexobj(values) else np.stack(turned).real

    def vectors_on(
        self, e_theta: Sampled, e_phi: Sampled, grid: HemisphereGrid, turn_deg: float
    ) -> tuple[OnGrid, OnGrid]:
        """Interpolate theta and phi components of vectors, turned likewise, to a grid.

        Between pixels the components along three fixed axes are interpolated, since those along
        theta and phi are undefined at the zenith.
        """
        if self.theta is not None:
            return tuple(self.scalars_on(one, grid, turn_deg) for one in (e_theta, e_phi))
        theta, phi = healpy.pix2ang(self.nside, np.arange(e_theta.shape[-1]))
        along = [a * e_theta + b * e_phi for a, b in zip(*_axes(theta, phi), strict=True)]
        own_phi = grid.phi - np.radians(turn_deg)
        fixed = [beam_fields.from_rings(one, grid.theta, own_phi) for one in along]
        back = _axes(grid.theta[:, None], own_phi[None])
        return tuple(sum(a * one for a, one in zip(axis, fixed, strict=True)) for axis in back)


def _axes(theta: np.ndarray, phi: np.ndarray) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """East, North and up components of the unit vectors along theta and phi."""
    zero = np.zeros(np.broadcast_shapes(theta.shape, phi.shape))
    along_theta = [np.cos(theta) * np.cos(phi), np.cos(theta) * np.sin(phi), zero - np.sin(theta)]
    return along_theta, [zero - np.sin(phi), zero + np.cos(phi), zero]


@dataclass(frozen=True, repr=False, eq=False)
class SampledBeams(checks.Described, BeamSource):
    """Fields of antennas, or beams of products, in directions of a grid or of HEALPix pixels.

    Create them from arrays with :func:`sampled_beams`.

    Attributes
    ----------
    frequencies_mhz : (frequencies,) array
        Increasing.
    directions : Directions
        Directions along the last axes of the arrays.
    e_theta, e_phi : (frequencies, antennas, ...) complex array or None
        Response to the theta and phi components of the incident field.
    products : (frequencies, products, ...) array or None
        The beam of every real product, instead of the fields.
    absolute : bool
        Whether B_k = V_k for a source of 1 K sr: the scale is that of the data in K. Otherwise the
        autos are scaled to integrate to one on average.
    path : str
        Origin of the beams, for messages.
    turntable_offset_deg : float
        True minus stated turntable angle, from East towards North.
    normalise : bool or None
        Scale the beams so that autos integrate to one on average; by default if they are not
        absolute.
    """

    frequencies_mhz: Float[np.ndarray, " frequencies"]
    directions: Directions
    e_theta: Complex[np.ndarray, "frequencies antennas *directions"] | None = None
    e_phi: Complex[np.ndarray, "frequencies antennas *directions"] | None = None
    products: Float[np.ndarray, "frequencies products *directions"] | None = None
    absolute: bool = False
    path: str = "the beams"
    turntable_offset_deg: float = 0.0
    normalise: bool | None = None

    def description(self) -> tuple[str, ...]:
        kind = "E fields of" if self.products is None else "product beams of"
        scale = "K per K" if self.absolute else "normalised so that autos integrate to one"
        frequencies = checks.listed(tuple(f"{f:g}" for f in self.frequencies_mhz))
        at, where = self.directions, f"HEALPix pixels of NSIDE {self.directions.nside}"
        if at.theta is not None:
            where = f"{len(at.theta)} theta x {at.n_phi} phi"
        return f"{kind} {self.n_ports} antennas, {where}", f"at {frequencies} MHz; {scale}"

    @property
    def n_ports(self) -> int:
        if self.products is None:
            return self.e_theta.shape[1]
        return antennas_of(self.products.shape[1])

    @property
    def has_fields(self) -> bool:
        return self.products is None

    def fields(self, frequency_mhz: float, grid: HemisphereGrid) -> AntennaFields:
        if self.products is not None:
            raise InputError(f"{self.path}: product beams, but this needs the E fields of antennas")
        parts = self._at(frequency_mhz, self.e_theta, self.e_phi)
        turned = self.directions.vectors_on(*parts, grid, self.turntable_offset_deg)
        return AntennaFields(*turned, grid)

    def patterns(self, frequency_mhz: float, grid: HemisphereGrid) -> beam_fields.Pairs:
        if self.products is None:
            return super().patterns(frequency_mhz, grid)
        (beams,) = self._at(frequency_mhz, self.products)
        return to_matrix(self.directions.scalars_on(beams, grid, self.turntable_offset_deg))

    def _at(self, frequency_mhz: float, *parts: np.ndarray) -> list[np.ndarray]:
        mhz = self.frequencies_mhz
        return beam_fields.at_frequency(self.path, mhz, frequency_mhz, *parts, rule="spline")

    def beams(self, frequency_mhz: float, lmax: int) -> ProductBeams:
        """Return the beams of all products in K per K.

        Raises
        ------
        InputError
            Outside the frequencies, or if autos that must be scaled have no positive integral.
        """
        grid = self.directions.quadrature(lmax)
        patterns = to_real(self.patterns(frequency_mhz, grid))
        if not self.absolute if self.normalise is None else self.normalise:
            scale = float(grid.integrate(patterns[auto_indices(self.n_ports)]).mean())
            if not scale > 0.0:
                wrong = f"{self.path}: the autos integrate to {scale:g} sr on average; expected > 0"
                raise InputError(wrong)
            patterns = patterns / scale
        return ProductBeams(grid.modes(patterns, lmax), float(frequency_mhz))


def sampled_beams(
    frequencies_mhz: Any,
    *,
    e_theta: Any = None,
    e_phi: Any = None,
    products: Any = None,
    theta_deg: Any = None,
    phi_deg: Any = None,
    absolute: bool = False,
    path: str = "the beams",
) -> SampledBeams:
    """Create beams from arrays.

    Give either ``e_theta`` and ``e_phi``, or ``products``; either ``theta_deg`` and ``phi_deg``, or
    neither for HEALPix pixels (RING; theta from the zenith, phi from East towards North).

    Parameters
    ----------
    frequencies_mhz : float or (frequencies,) array
        Increasing. For a single number the arrays have no axis of frequencies.
    e_theta, e_phi : (frequencies, antennas, theta, phi) or (frequencies, antennas, pixels) array
        Complex response of each antenna to the theta and phi components of the incident field,
        with one phase centre for all antennas, exp(+i w t).
    products : (frequencies, products, theta, phi) or (frequencies, products, pixels) array
        Real beams of the products 00R, 01R, 01I, 02R, ..., as in :func:`.products.labels`.
    theta_deg : (theta,) array
        Increasing from the zenith to the horizon or beyond; only directions above it are used.
    phi_deg : (phi,) array
        360 k / n, k = 0 .. n - 1, from East towards North; 360 may be included.
    absolute : bool
        See :class:`SampledBeams`.
    path : str
        Origin of the beams, for messages.

    Returns
    -------
    SampledBeams

    Raises
    ------
    InputError
        If the arrays do not match, are not finite above the horizon, or do not cover it.
    """
    fields = {"e_theta": e_theta, "e_phi": e_phi} if products is None else {"products": products}
    if (e_theta is None) != (e_phi is None) or (e_theta is None) == (products is None):
        raise InputError(f"{path}: give e_theta and e_phi, or products")
    if (theta_deg is None) != (phi_deg is None):
        raise InputError(f"{path}: give both theta_deg and phi_deg, or neither for HEALPix")
    grid = {} if theta_deg is None else {"theta_deg": theta_deg, "phi_deg": phi_deg}
    alone = np.ndim(frequencies_mhz) == 0
    filled = {name: np.ma.filled(x, np.nan) for name, x in fields.items()}
    arrays = {name: x[None] if alone else x for name, x in filled.items()}
    arrays |= {name: np.atleast_1d(np.asarray(x, dtype=float)) for name, x in grid.items()}
    arrays["frequency_mhz"] = np.atleast_1d(np.asarray(frequencies_mhz, dtype=float))
    checks.require_positive(f"{path}: frequency_mhz", arrays["frequency_mhz"])
    kind = "complex" if products is None else "real"
    given = layout(tuple(fields), bool(grid), kind).checked(path, arrays, {}).arrays
    some = given[next(iter(fields))]
    directions = Directions.of(given.get("theta_deg"), given.get("phi_deg"), some.shape[-1], path)
    if products is not None:
        with naming(path):
            antennas_of(some.shape[1])
    above = {name: directions.above(given[name], f"{path}: {name}") for name in fields}
    return SampledBeams(given["frequency_mhz"], directions, **above, absolute=absolute, path=path)


FIELDS = ("e_theta_real", "e_theta_imag", "e_phi_real", "e_phi_imag")
POWER = "product_beam"
WHAT = "sampled beams"
HINT = "lusee_bayes.instrument.beams.sampled.write_sampled_beams writes one"


def layout(names: tuple[str, ...], grid: bool, kind: Kind = "real", said: Any = None) -> Layout:
    """Return the layout of a file or of arrays: fields or beams on a grid or on HEALPix pixels."""
    first = "product" if names[0] in ("products", POWER) else "antenna"
    directions = ("theta", "phi") if grid else ("pixel",)
    # values below the horizon are arbitrary
    values = Variable(("frequency", first, *directions), kind, missing=True)
    angle = partial(Variable, low=0.0, grows=True, unit="deg")
    angles = {"theta_deg": angle(("theta",), high=180.0), "phi_deg": angle(("phi",), high=360.0)}
    frequency = Variable(("frequency",), low=0.0, grows=True, unit="MHz")
    arrays = {"frequency_mhz": frequency, **dict.fromkeys(names, values)}
    return Layout(WHAT, arrays | (angles if grid else {}), said or {})


def read_sampled_beams(path: str | Path) -> SampledBeams:
    """Read a file written by :func:`write_sampled_beams`, or one of the same layout.

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
    path = files.user_path(path)
    if path.is_file() and formats.is_fits(path):
        read = partial(formats.read_fits, path, hint=HINT)
    else:
        read = partial(formats.read_netcdf, path, formats.BEAMS, hint=HINT)
    present = read(layout=Layout(WHAT)).names
    names = (POWER,) if POWER in present else FIELDS
    said = {"absolute": Attribute("boolean")}
    said |= {"products": Attribute("text")} if POWER in present else {}
    content = read(layout=layout(names, "theta_deg" in present, said=said))
    arrays, given = content.arrays, {}
    if POWER in arrays:
        names = [name.strip() for name in content.values["products"].split(",")]
        with naming(path):
            expected = labels(antennas_of(arrays[POWER].shape[1]))
        if sorted(names) != sorted(expected):
            raise InputError(
                f"{path}: products is {', '.join(names)}, expected the names of its "
                f"{len(expected)} product beams: {', '.join(expected)}"
            )
        given["products"] = arrays[POWER][:, [names.index(name) for name in expected]]
    else:
        for name in ("e_theta", "e_phi"):
            # infinity times 1j would be NaN, with a warning
            parts = np.stack([arrays[f"{name}_{part}"] for part in ("real", "imag")], axis=-1)
            given[name] = parts.view(complex)[..., 0]
    angles = {name: arrays.get(name) for name in ("theta_deg", "phi_deg")}
    options = {"absolute": content.values["absolute"], "path": str(path)}
    return sampled_beams(arrays["frequency_mhz"], **given, **angles, **options)


def write_sampled_beams(path: str | Path, beams: SampledBeams) -> Path:
    """Write beams to netCDF, or to FITS if the name ends in .fits or .fit; complete or not at all.

    Parameters
    ----------
    path : str or Path
    beams : SampledBeams

    Returns
    -------
    Path
    """
    path, theta = files.user_path(path), beams.directions.theta
    arrays = {"frequency_mhz": beams.frequencies_mhz}
    said = {"format": formats.BEAMS, "absolute": int(beams.absolute)}
    if beams.products is None:
        parts = (beams.e_theta.real, beams.e_theta.imag, beams.e_phi.real, beams.e_phi.imag)
        arrays |= dict(zip(FIELDS, parts, strict=True))
    else:
        arrays[POWER] = beams.products
        said["products"] = ",".join(labels(beams.n_ports))
    declared = layout(tuple(arrays)[1:], theta is not None)
    if theta is not None:
        arrays["theta_deg"], n = np.degrees(theta), beams.directions.n_phi
        arrays["phi_deg"] = 360.0 * np.arange(n) / n
    with files.replacing(path) as partly:
        if path.suffix.lower() in (".fits", ".fit"):
            hdus = [fits.PrimaryHDU(header=fits.Header(list(said.items())))]
            hdus += [fits.ImageHDU(a.copy(), name=name) for name, a in arrays.items()]
            fits.HDUList(hdus).writeto(partly)
        else:
            formats.write_netcdf(formats.as_dataset(formats.BEAMS, declared, arrays, said), partly)
    return path


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
    """Convert a UVBeam of type efield, with one port for every feed.

    Parameters
    ----------
    beam : pyuvdata.UVBeam
        Of type efield, in coordinates az_za or healpix (RING); scaled so that the autos integrate
        to one, since the unit of UVBeams is arbitrary.
    conjugate : bool
        Use the complex conjugates, for fields computed with exp(-i w t).
    path : str
        Origin of the beam, for messages.

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
        wrong = f"{path} is a UVBeam of type {beam.beam_type}; crosses need fields, type efield"
        raise InputError(wrong)
    if (system := beam.pixel_coordinate_system) not in ("az_za", "healpix"):
        raise InputError(f"{path} has coordinates {system}; expected az_za or healpix")
    basis = np.asarray(beam.basis_vector_array)
    unit = np.eye(2).reshape(2, 2, *(1,) * (basis.ndim - 2))
    if basis.shape[:2] != (2, 2) or not np.allclose(basis, unit, atol=1e-9):
        raise InputError(
            f"{path} has fields along vectors other than azimuth and zenith angle "
            "(basis_vector_array is not the unit matrix); convert it first"
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
    fields = {name: one.conj() if conjugate else one for name, one in fields.items()}
    return sampled_beams(np.asarray(beam.freq_array) / 1e6, **fields, **angles, path=path)


def read_beam(path: str | Path) -> BeamSource:
    """Read a beam file of any supported kind.

    These are luseepy's scalar beams (FITS version 2) and responses (version 3), sampled beams and
    pyuvdata's beam FITS (both :mod:`.sampled`).

    Parameters
    ----------
    path : str or Path

    Returns
    -------
    BeamSource
        ScalarBeam, PortResponse or SampledBeams.

    Raises
    ------
    InputError
        If there is no file, or as the reader of its kind.
    """
    path = require_file(path, "beam file", "check beam.file")
    return READERS[beam_kind(path)](path)


def beam_kind(path: str | Path) -> str:
    """Return a beam file's kind, the ``model`` of a scenario; by default luseepy's scalar.

    Raises
    ------
    InputError
        If the file is FITS or HDF5, but damaged.
    """
    try:
        path = require_file(path, "beam file")
    except InputError:
        return "luseepy"
    in_fits = formats.is_fits(path)
    names = set(formats.image_names(path)) if in_fits else set()
    is_ours = names & {FIELDS[0], POWER} if in_fits else formats.format_of(path) == formats.BEAMS
    if is_ours or formats.has_words(path, formats.UVBEAM_WORDS):
        return "sampled"
    return "response" if "h_theta_real" in names else "luseepy"


def read_sampled(path: str | Path) -> SampledBeams:
    """Read sampled beams, from the package's own files or pyuvdata's.

    Raises
    ------
    InputError
        As :func:`read_sampled_beams` and :func:`read_uvbeam`.
    """
    path = require_file(path, "beam file", "check beam.file")
    is_uvbeam = formats.has_words(path, formats.UVBEAM_WORDS)
    return read_uvbeam(path) if is_uvbeam else read_sampled_beams(path)


READERS = {"sampled": read_sampled, "response": read_response, "luseepy": read_scalar_beam}
