"""Beams in luseepy's files: responses of the ports, and scalar beams.

Their headers may state conventions, which are checked; an absent word, or "UNKNOWN" (luseepy's
placeholder), states nothing. For data made by luseepy, its own quadratures over the directions of a
file are available.

**Responses** describe coupled antennas over ground, with their receivers. FITS version 3: bare
effective lengths H_theta, H_phi (port, frequency, theta, phi) in m, RMS, for a wave arriving from
(theta, phi), phi from East towards North; impedance ZA and its resistive parts Rsky, Rmoon, Rloss
(frequency, port, port) in Ohm, with ZA + ZA^H = 2 (Rsky + Rmoon + Rloss); freq in MHz, theta and
phi in degrees. At the receivers' inputs, one-sided, ::

    V_ab = k eta0 / lambda^2 int (M Ht)_a conj((M Ht)_b) + (M Hp)_a conj((M Hp)_b) T dOmega
           + 4 k (M (T_moon Rmoon + T_antenna Rloss) M^H)_ab    in V^2/Hz.

An enclosure at 1 K gives U = 4 k M (ZA + ZA^H) / 2 M^H; V_ab / sqrt(U_aa U_bb) is in K. Between the
file's frequencies luseepy interpolates impedances and the integrals of open ports (without M)
linearly, and computes M from the interpolated ZA.

**Scalar beams** are the field pattern of one arm, used for every port. FITS version 2: images
Etheta_real, Etheta_imag, EPhi_real, EPhi_imag (frequency, theta, phi), the response to a wave
arriving from (theta, phi), phi from East towards North, time convention exp(+i w t); gain_conv
g(frequency), freq in MHz, Z_real and Z_imag in Ohm. Visibilities in K are ::

    T_ij = sqrt(g_i g_j) / (4 pi) int (Et_i conj(Et_j) + Ep_i conj(Ep_j)) I dOmega,

so fields times sqrt(2 g / 4 pi) give product beams without any other normalisation. Between the
file's frequencies luseepy interpolates g and the integrals linearly, not the fields.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from jaxtyping import Complex, Float
from scipy import fft, special
from scipy.constants import Boltzmann, physical_constants, speed_of_light

from lusee_bayes.core import arrays, formats, harmonics, reading
from lusee_bayes.core.checks import Described, counted, extent
from lusee_bayes.core.errors import InputError, require_known
from lusee_bayes.core.layouts import UNSTATED, Attribute, Layout, Variable
from lusee_bayes.instrument.beams import fields as beam_fields
from lusee_bayes.instrument.beams.fields import AntennaFields, HemisphereGrid, ProductBeams, on_grid
from lusee_bayes.instrument.beams.source import BeamSource, Circuit, JFETReceiver, Receiver
from lusee_bayes.instrument.products import N_ANTENNAS, auto_indices, to_real

# words of headers that this package assumes, in lower case
HEADERS = reading.table_beside(__file__)
CONVENTIONS: Mapping[str, list[str]] = HEADERS["conventions"]
# of responses: the input that luseepy converts to effective lengths, by NORM_KIND
SOURCES = ("NORM_KIND", "INPUT_KIND", "FIELD_KIND", "FIELD_UNIT")
CONVERTED: Mapping[str, dict[str, list[str]]] = HEADERS["converted"]


def require_conventions(path: str | Path, said: Mapping[str, Any]) -> None:
    """Check the words of a header against the conventions of this package.

    Parameters
    ----------
    path : str or Path
        The file, for the message.
    said : mapping of str to str
        Words of the header.

    Raises
    ------
    InputError
        If a word contradicts them.
    """
    stated = {key: str(value).strip().lower() for key, value in said.items()}
    stated = {key: text for key, text in stated.items() if text not in UNSTATED}
    kind = stated.get("NORM_KIND", "already-effective-length")
    require_known(f"{path}: NORM_KIND is", kind, CONVERTED)
    for key, allowed in (CONVENTIONS | CONVERTED[kind]).items():
        if key in stated and stated[key] not in allowed:
            raise InputError(
                f"{path}: {key} is '{said[key]}', expected '{' or '.join(allowed)}'; convert the "
                "file with luseepy, or correct its header"
            )


class BandLimitedGrid(HemisphereGrid):
    """luseepy's rule for responses: the pattern is band-limited on the whole sphere.

    Samples below the horizon are zeros, and samples on it count half. The trigonometric polynomial
    in theta through all of them is integrated exactly.

    References
    ----------
    McEwen and Wiaux 2011, IEEE Trans. Signal Process. 59, 5876 (symmetric sampling).
    """

    @classmethod
    def of(cls, theta: beam_fields.Angles, n_phi: int) -> BandLimitedGrid:
        """Return the rule for ``theta`` in equal steps from 0 to pi / 2, both included."""
        # lambda_00 = 1 / sqrt(4 pi)
        even = cls(theta, np.ones_like(theta), n_phi).polar_weights(0)[:, 0]
        return cls(theta, even * np.sqrt(4.0 * np.pi), n_phi)

    def polar_weights(self, lmax: int) -> Float[np.ndarray, "theta modes"]:
        """Return the integrals of each sample's cardinal function times lambda_lm(theta)."""
        n = len(self.theta)
        # exact: the product has degree 2 n + lmax in theta
        nodes, weights = special.roots_legendre(4 * n + lmax)
        fine = np.arccos(nodes)
        polar = harmonics.polar_functions(fine, lmax) * weights[:, None]
        _, m = harmonics.mode_numbers(lmax)
        summed = np.empty((n, polar.shape[1]))
        for parity in (0, 1):
            same = m % 2 == parity
            summed[:, same] = cardinal_functions(fine, 2 * n - 2, parity)[:, :n].T @ polar[:, same]
        summed[-1] /= 2.0
        return summed


def cardinal_functions(theta: beam_fields.Angles, intervals: int, parity: int) -> np.ndarray:
    """Return trigonometric polynomials that are 1 at one sample and 0 at the others.

    The samples are pi k / intervals, k = 0 .. intervals.

    Parameters
    ----------
    theta : (theta,) array
        Where to evaluate them, in radians.
    intervals : int
    parity : {0, 1}
        Whether they continue beyond the poles evenly (0) or oddly (1), like the Fourier
        coefficients of a smooth function on the sphere for even and odd m.

    Returns
    -------
    (theta, samples) array
    """
    waves = theta[:, None] * np.arange(intervals + 1)
    if parity == 0:
        of_wave = fft.dct(np.eye(intervals + 1), type=1, axis=0) / intervals
        of_wave[[0, -1]] /= 2.0
        return np.cos(waves) @ of_wave
    # odd functions are zero at the poles
    return np.sin(waves) @ np.pad(fft.dst(np.eye(intervals - 1), type=1, axis=0) / intervals, 1)


VACUUM_OHM = physical_constants["characteristic impedance of vacuum"][0]
LENGTHS = ("H_theta", "H_phi")
MATRICES = ("ZA", "Rsky", "Rmoon", "Rloss")
AXES = ("freq", "theta", "phi")
MATRIX = Variable(("freq", N_ANTENNAS, N_ANTENNAS), unit="Ohm")


def parts_of(*names: str) -> list[str]:
    """Return the names of the images of real and imaginary parts."""
    return [f"{name}_{part}" for name in names for part in ("real", "imag")]


IMAGES = {
    "freq": Variable(("freq",), low=0.0, grows=True, unit="MHz"),
    **{name: Variable((name,), grows=True, unit="deg") for name in AXES[1:]},
    **dict.fromkeys(parts_of(*LENGTHS), Variable((N_ANTENNAS, *AXES), unit="m")),
    **dict.fromkeys(parts_of(*MATRICES), MATRIX),
}
WORDS = dict.fromkeys((*CONVENTIONS, *SOURCES), Attribute("word", optional=True))
RESPONSE_LAYOUT = Layout("a four-port response of luseepy, FITS version 3", IMAGES, WORDS)
# files store the matrices in single precision, and three of them are added
RESISTANCE_TOLERANCE = 1e-6


@dataclass(frozen=True, eq=False, repr=False)
class LuseepyBeam(Described, BeamSource):
    """The fields of a file in directions of a grid, at several frequencies.

    Attributes
    ----------
    path : str
        The file, for error messages.
    frequencies_mhz : (frequencies,) array
    theta : (theta,) array
        From 0 to pi / 2 in equal steps; azimuths are 2 pi k / n_phi.
    e_theta, e_phi : (frequencies, ..., theta, phi) complex array
        Response to the theta and phi components of the incident field.
    interpolation : {"linear", "spline"}
        Rule between the frequencies: luseepy's (linear in products of fields and in impedances), or
        cubic splines through fields and impedances.
    turntable_offset_deg : float
        True minus stated turntable angle, from East towards North.
    luseepy_quadrature : bool
        Integrate with luseepy's own rule, for data made by luseepy.
    moon_k : float
        Temperature of the ground in K.
    """

    path: str
    frequencies_mhz: Float[np.ndarray, " frequencies"]
    theta: beam_fields.Angles
    e_theta: Complex[np.ndarray, "frequencies *ports theta phi"]
    e_phi: Complex[np.ndarray, "frequencies *ports theta phi"]
    interpolation: beam_fields.Interpolation = field(default="linear", kw_only=True)
    turntable_offset_deg: float = field(default=0.0, kw_only=True)
    luseepy_quadrature: bool = field(default=False, kw_only=True)
    moon_k: float = field(default=0.0, kw_only=True)

    def description(self) -> tuple[str, ...]:
        mhz = self.frequencies_mhz
        middle = float(mhz[len(mhz) // 2])
        autos = replace(self, moon_k=1.0).background(middle)[auto_indices(self.n_ports)]
        return (
            f"{counted(self.n_ports, 'port')}, {extent(mhz, 'MHz')} ({len(mhz)} frequencies)",
            f"{len(self.theta)} angles from the zenith to the horizon, {self.n_phi} azimuths",
            f"{autos.mean():.3f} of an auto at {middle:g} MHz comes from the ground",
        )

    @property
    def n_phi(self) -> int:
        """Number of azimuths."""
        return self.e_theta.shape[-1]

    @abstractmethod
    def luseepy_grid(self) -> HemisphereGrid:
        """Return the directions of the file with luseepy's rule."""

    @abstractmethod
    def _received(
        self, parts: list[np.ndarray], file_mhz: float, mhz: float, grid: HemisphereGrid
    ) -> AntennaFields:
        """Fields of all ports at ``mhz``, from the file's e_theta and e_phi at ``file_mhz``."""

    def fields(self, frequency_mhz: float, grid: HemisphereGrid) -> AntennaFields:
        """Return the fields of the ports in sqrt(1 / sr); their products are beams in K per K.

        Between the file's frequencies this needs splines. With linear interpolation the fields
        themselves are interpolated here, for pictures; use :meth:`beams` for products.
        """
        parts = self._at(frequency_mhz, self.e_theta, self.e_phi)
        return self._received(parts, frequency_mhz, frequency_mhz, grid)

    def beams(self, frequency_mhz: float, lmax: int) -> ProductBeams:
        # these nodes treat the cut at the horizon exactly
        rings, azimuths = 2 * max(len(self.theta), lmax + 1), max(self.n_phi, 2 * lmax + 2)
        exact = HemisphereGrid.gauss_legendre(rings, azimuths)
        grid = self.luseepy_grid() if self.luseepy_quadrature else exact
        if self.interpolation == "spline":
            weighted = [(1.0, self.fields(frequency_mhz, grid))]
        else:
            known = self.frequencies_mhz
            weighted = [
                (w, self._received([self.e_theta[k], self.e_phi[k]], known[k], frequency_mhz, grid))
                for k, w in self._neighbours(frequency_mhz)
            ]
        options = {"lmax": lmax, "normalise": False}
        modes = sum(w * beam_fields.product_modes(part, **options) for w, part in weighted)
        return ProductBeams(modes, float(frequency_mhz))

    def interpolated(self, frequency_mhz: float) -> beam_fields.Interpolation | None:
        return self.interpolation if len(self._neighbours(frequency_mhz)) > 1 else None

    def _neighbours(self, frequency_mhz: float) -> list[tuple[int, float]]:
        return beam_fields.neighbours(self.path, self.frequencies_mhz, frequency_mhz)

    def _at(self, frequency_mhz: float, *parts: np.ndarray) -> list[np.ndarray]:
        mhz, rule = self.frequencies_mhz, self.interpolation
        return beam_fields.at_frequency(self.path, mhz, frequency_mhz, *parts, rule=rule)


@dataclass(frozen=True, eq=False, repr=False)
class PortResponse(LuseepyBeam):
    """Four coupled ports at several frequencies, with their receivers.

    Attributes
    ----------
    e_theta, e_phi : (frequencies, ports, theta, phi) complex array
        Effective lengths H_theta and H_phi in m.
    impedance_ohm : (frequencies, ports, ports) complex array
        ZA.
    moon_ohm, loss_ohm : (frequencies, ports, ports) complex array
        Rmoon and Rloss.
    receiver : Receiver or None
        Receivers at the ports; None leaves them open.
    receiver_said : bool
        Whether to use these receivers for all data, in place of those that data state.
    antenna_k : float
        Temperature of the lossy antennas in K.
    """

    n_ports: ClassVar[int] = N_ANTENNAS

    impedance_ohm: Complex[np.ndarray, "frequencies ports ports"]
    moon_ohm: Complex[np.ndarray, "frequencies ports ports"]
    loss_ohm: Complex[np.ndarray, "frequencies ports ports"]
    receiver: Receiver | None = JFETReceiver()
    receiver_said: bool = True
    antenna_k: float = 0.0

    def luseepy_grid(self) -> BandLimitedGrid:
        """Return the directions of the file with the rule of luseepy's four-port engine."""
        return BandLimitedGrid.of(self.theta, self.n_phi)

    def behind(self, receiver: Receiver | None) -> PortResponse:
        return self if receiver is None or self.receiver_said else replace(self, receiver=receiver)

    def description(self) -> tuple[str, ...]:
        mhz = self.frequencies_mhz
        kelvin = self.per_kelvin(float(mhz[len(mhz) // 2]))
        return *super().description(), f"1 K is {extent(kelvin, 'V^2/Hz')} behind the receivers"

    def circuit(self, frequency_mhz: float) -> Circuit:
        """Return antennas and receivers; InputError outside the frequencies of the file."""
        parts = (self.impedance_ohm, self.moon_ohm, self.loss_ohm)
        return Circuit(frequency_mhz, *self._at(frequency_mhz, *parts), self.receiver)

    def per_kelvin(self, frequency_mhz: float) -> Float[np.ndarray, " ports"]:
        """Return U_aa, the V^2/Hz at each receiver's input in an enclosure at 1 K."""
        return self.circuit(frequency_mhz).per_kelvin.diagonal().real

    def _received(self, parts, file_mhz, mhz, grid):
        # product beams are halves of the sums over polarisations
        scale = np.sqrt(2.0 * Boltzmann * VACUUM_OHM / self.per_kelvin(mhz))
        mixing = scale[:, None] * self.circuit(mhz).loading * (1e6 * file_mhz / speed_of_light)
        turn_deg = self.turntable_offset_deg
        turned = (np.stack([on_grid(h, self.theta, grid, turn_deg) for h in p]) for p in parts)
        return AntennaFields(*(np.tensordot(mixing, part, axes=1) for part in turned), grid)

    def background(self, frequency_mhz: float) -> Float[arrays.Array, " products"]:
        if self.moon_k == self.antenna_k == 0.0:
            return super().background(frequency_mhz)
        circuit = self.circuit(frequency_mhz)
        seen = circuit.emitted(self.moon_k * circuit.moon_ohm + self.antenna_k * circuit.loss_ohm)
        root = np.sqrt(self.per_kelvin(frequency_mhz))
        return to_real(seen / (root[:, None] * root[None]))


def read_response(path: str | Path) -> PortResponse:
    """Read a four-port response of luseepy, FITS version 3.

    Parameters
    ----------
    path : str or Path

    Returns
    -------
    PortResponse
        With luseepy's receivers on the ports.

    Raises
    ------
    InputError
        For a missing or truncated file, a missing image, wrong shapes, directions other than the
        hemisphere above the horizon, frequencies that do not increase, numbers that are not finite,
        resistances that do not add up, or a header that states other conventions.
    """
    response = formats.read_fits(path, RESPONSE_LAYOUT, "check beam.file")
    require_conventions(path, response.values)
    images = response.arrays
    frequencies, theta_deg, phi_deg = (images[name] for name in AXES)
    for name, degrees, last in (("theta", theta_deg, 90.0), ("phi", phi_deg, 360.0)):
        if not np.allclose(degrees, np.linspace(0.0, last, len(degrees)), rtol=0, atol=1e-9):
            wrong = f"{path}: {name} goes {degrees[0]:g} to {degrees[-1]:g}, expected 0 to {last:g}"
            raise InputError(wrong)
    complex_ = {n: images[f"{n}_real"] + 1j * images[f"{n}_imag"] for n in (*LENGTHS, *MATRICES)}
    # the last azimuth repeats the first
    h_theta, h_phi = (np.moveaxis(complex_[name], 0, 1)[..., :-1] for name in LENGTHS)
    impedance, sky, moon, loss = (complex_[name] for name in MATRICES)
    resistance = (impedance + impedance.conj().swapaxes(1, 2)) / 2.0
    off = np.abs(sky + moon + loss - resistance).max() / np.abs(resistance).max()
    if off > RESISTANCE_TOLERANCE:
        wrong = f"{path}: Rsky + Rmoon + Rloss differ from (ZA + ZA^H) / 2 by a relative {off:.1g}"
        raise InputError(wrong)
    theta = np.linspace(0.0, np.pi / 2.0, len(theta_deg))
    return PortResponse(str(path), frequencies, theta, h_theta, h_phi, impedance, moon, loss)


FIELD_NAMES = ("Etheta", "EPhi")
IMPEDANCE = ("Z_real", "Z_imag")
FIELD, OHM = Variable(("freq", "theta", "phi")), Variable(("freq",), optional=True, unit="Ohm")
ENDS = {"THETA_MIN": 0.0, "THETA_MAX": 90.0, "PHI_MIN": 0.0, "PHI_MAX": 360.0}
SCALAR_IMAGES = {
    **dict.fromkeys(parts_of(*FIELD_NAMES), FIELD),
    "freq": Variable(("freq",), low=0.0, grows=True, unit="MHz"),
    "gain_conv": Variable(("freq",)),
    **dict.fromkeys(IMPEDANCE, OHM),
}
SCALAR_WORDS = {
    **{key: Attribute("integer", low=2.0) for key in ("THETA_N", "PHI_N")},
    **{key: Attribute(low=degrees, high=degrees) for key, degrees in ENDS.items()},
    **dict.fromkeys(CONVENTIONS, Attribute("word", optional=True)),
}
SCALAR_LAYOUT = Layout("a scalar beam file of luseepy, FITS version 2", SCALAR_IMAGES, SCALAR_WORDS)
# luseepy turns the pattern by 90 degrees from port to port: North, West, South, East for an arm
# that points North
ROTATIONS_DEG = (0.0, 90.0, 180.0, 270.0)
# luseepy fades beams out by 1 - (arctan((theta - pi / 2) / width) / pi + 1 / 2)^2
TAPER_WIDTH = 0.03


@dataclass(frozen=True, eq=False, repr=False)
class ScalarBeam(LuseepyBeam):
    """The pattern of one arm, used for every port, without coupling between arms.

    Attributes
    ----------
    e_theta, e_phi : (frequencies, theta, phi) complex array
        Fields in the unit of the file.
    gain : (frequencies,) array
        gain_conv of the file.
    impedance_ohm : (frequencies,) complex array or None
        Impedance of the arm; None if the file has none.
    taper : bool
        Fade out towards the horizon as luseepy does.
    rotations_deg : tuple of float
        Rotation of the pattern for each port, from East towards North.
    """

    gain: Float[np.ndarray, " frequencies"]
    impedance_ohm: Complex[np.ndarray, " frequencies"] | None = None
    taper: bool = True
    rotations_deg: tuple[float, ...] = ROTATIONS_DEG

    @property
    def n_ports(self) -> int:
        return len(self.rotations_deg)

    def luseepy_grid(self) -> HemisphereGrid:
        """Return the directions of the file with sin(theta) dtheta dphi, in steps up to pi / 2."""
        return HemisphereGrid(self.theta, np.sin(self.theta) * self.theta[1], self.n_phi)

    def _received(self, parts, file_mhz, mhz, grid):
        (gain,) = self._at(mhz, self.gain)
        scale = np.full(len(grid.theta), np.sqrt(2.0 * float(gain) / (4.0 * np.pi)))
        if self.taper:
            below = np.arctan((grid.theta - np.pi / 2.0) / TAPER_WIDTH) / np.pi + 0.5
            scale = scale * (1.0 - below**2)
        angles = [angle + self.turntable_offset_deg for angle in self.rotations_deg]
        turned = [np.stack([on_grid(p, self.theta, grid, a) for a in angles]) for p in parts]
        return AntennaFields(*((x * scale[:, None]).astype(np.complex128) for x in turned), grid)

    def impedance(self, frequency_mhz: float) -> complex | None:
        if self.impedance_ohm is None:
            return None
        (ohm,) = self._at(frequency_mhz, self.impedance_ohm)
        return complex(ohm)

    def background(self, frequency_mhz: float) -> Float[arrays.Array, " products"]:
        """Return the visibilities without any sky: the emission of the ground.

        The ground fills the part of an auto's beam that the sky does not. Arms in an enclosure of
        one temperature are assumed to be uncorrelated, as they are without coupling, so a cross
        receives the sky's part with the opposite sign.
        """
        if self.moon_k == 0.0:
            return super().background(frequency_mhz)
        sky = np.sqrt(4.0 * np.pi) * self.beams(frequency_mhz, 0).modes[:, 0]
        return self.moon_k * (to_real(np.eye(self.n_ports, dtype=np.complex128)) - sky)


def read_scalar_beam(path: str | Path) -> ScalarBeam:
    """Read a scalar beam file of luseepy, FITS version 2.

    Parameters
    ----------
    path : str or Path

    Returns
    -------
    ScalarBeam

    Raises
    ------
    InputError
        For a missing or truncated file, a missing image, wrong shapes, directions other than the
        hemisphere above the horizon, frequencies that do not increase, numbers that are not finite,
        or a header that states other conventions.
    """
    beam = formats.read_fits(path, SCALAR_LAYOUT, "check beam.file")
    images, said, sizes = beam.arrays, beam.values, beam.sizes
    require_conventions(path, said)
    if (sizes["theta"], sizes["phi"]) != (said["THETA_N"], said["PHI_N"]):
        raise InputError(
            f"{path}: the fields have {sizes['theta']} x {sizes['phi']} directions, the header "
            f"gives {said['THETA_N']} x {said['PHI_N']} (THETA_N, PHI_N)"
        )
    pair = [images[f"{name}_real"] + 1j * images[f"{name}_imag"] for name in FIELD_NAMES]
    # the last azimuth repeats the first
    e_theta, e_phi = (part[..., :-1] for part in pair)
    theta = np.linspace(0.0, np.pi / 2.0, sizes["theta"])
    z = images["Z_real"] + 1j * images["Z_imag"] if set(IMPEDANCE) <= set(images) else None
    return ScalarBeam(str(path), images["freq"], theta, e_theta, e_phi, images["gain_conv"], z)
