"""Sources of an instrument's beams, and the receivers at its ports.

Every kind of beams is one :class:`BeamSource`: the embedded antennas, luseepy's files, or beams in
directions. Code that uses beams does not depend on the kind. A new kind is one class and one line
in the test of the contract, :func:`lusee_bayes.testing.check_beam_source`.

**Circuit.** Antennas of impedance matrix ZA with open-circuit voltages v cause the voltages M v at
the inputs of receivers of impedance ZL (Thevenin's theorem), M = ZL (ZA + ZL)^-1. ZL follows
luseepy's models of receivers.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, NamedTuple

import numpy as np
from jaxtyping import Complex, Float
from pydantic import BeforeValidator, Field
from scipy.constants import Boltzmann

from lusee_bayes.core import formats, layouts, lazy
from lusee_bayes.core.arrays import Array, Values
from lusee_bayes.core.errors import require_known
from lusee_bayes.core.section import LARGEST, Positive, Section
from lusee_bayes.instrument.beams import fields as beam_fields
from lusee_bayes.instrument.products import N_ANTENNAS, auto_indices, to_real

Ohms = Complex[np.ndarray, "ports ports"]
Lines = Float[np.ndarray, "lines products modes"]
# grid of half a degree, on which patterns are interpolated to directions, and columns that overlap
N_FINE, N_PHI, MARGIN = 181, 720, 8
# matrices of the ports at every frequency
LOADS, BY_PORTS = ("ZL_real", "ZL_imag"), ("freq", N_ANTENNAS, N_ANTENNAS)
LOADS_LAYOUT = layouts.Layout(
    "loads ZL of four receivers, as in luseepy's four-port waterfalls",
    {
        "freq": layouts.Variable(("freq",), low=0.0, grows=True, unit="MHz"),
        **dict.fromkeys(LOADS, layouts.Variable(BY_PORTS, unit="Ohm")),
    },
)


class Receiver(ABC):
    """A receiver at the ports.

    Attributes
    ----------
    luseepy_name : str
        Name of luseepy's class for it.
    luseepy_parameters : dict of str
        Names of that class's parameters, and of the attributes here that give them.
    """

    luseepy_name: ClassVar[str]
    luseepy_parameters: ClassVar[dict[str, str]] = {}

    @abstractmethod
    def load(self, frequency_mhz: float) -> Ohms:
        """Return ZL in Ohm; InputError at a frequency that the receiver does not cover."""

    def receiver(self) -> Receiver:
        """Return ``self``: receivers given by parameters are sections of a scenario themselves."""
        return self


def _each_port(value: Any) -> Any:
    """Expand one number to all ports."""
    number = isinstance(value, int | float) and not isinstance(value, bool)
    return (value,) * N_ANTENNAS if number else value


def _ports(entry: Any) -> Any:
    four = Field(min_length=N_ANTENNAS, max_length=N_ANTENNAS)
    return Annotated[tuple[entry, ...], four, BeforeValidator(_each_port)]


NotNegative = Annotated[float, Field(ge=0, le=LARGEST)]


class JFETReceiver(Section, Receiver):
    """luseepy's preamplifiers; every entry is one number, or one for each port.

    Their input impedance follows the circuit ::

        Z = series + skin w^power + i w L + parallel / (1 + i w parallel C),    w in rad/s

    Defaults are luseepy's fits to the four spare flight preamplifiers. Nothing couples them.

    Attributes
    ----------
    capacitance_pf : tuple of float
        Capacitance.
    inductance_nh : tuple of float
        Inductance.
    parallel_ohm : tuple of float
        Parallel resistance.
    series_ohm : tuple of float
        Series resistance.
    skin_ohm : tuple of float
        Resistance of the skin effect.
    skin_power : tuple of float
        Power of the frequency in the skin effect.
    """

    luseepy_name: ClassVar[str] = "JFETReceiver"
    luseepy_parameters: ClassVar[dict[str, str]] = {
        "C_pf": "capacitance_pf", "L_nh": "inductance_nh", "Rp_ohm": "parallel_ohm",
        "Rs_ohm": "series_ohm", "a": "skin_ohm", "n": "skin_power",
    }  # fmt: skip

    model: Literal["jfet"] = "jfet"
    capacitance_pf: _ports(Positive) = (33.79, 35.32, 34.89, 36.85)
    inductance_nh: _ports(NotNegative) = (35.0, 36.4, 34.7, 8.5)
    parallel_ohm: _ports(Positive) = (1101e3, 331e3, 288e3, 375e3)
    series_ohm: _ports(NotNegative) = (0.21, 2.16, 3.71, 1.65)
    skin_ohm: _ports(NotNegative) = (5.2e-12, 6.9e-20, 2.2e-38, 1.9e-16)
    skin_power: _ports(Annotated[float, Field(ge=-10, le=10)]) = (1.39, 2.26, 4.35, 1.88)

    def load(self, frequency_mhz: float) -> Ohms:
        w, parallel = 2.0e6 * np.pi * frequency_mhz, np.array(self.parallel_ohm)
        z = np.array(self.series_ohm) + np.array(self.skin_ohm) * w ** np.array(self.skin_power)
        z = z + 1j * w * 1e-9 * np.array(self.inductance_nh)
        z = z + parallel / (1.0 + 1j * w * parallel * 1e-12 * np.array(self.capacitance_pf))
        return np.diag(z)


class CapacitorReceiver(Section, Receiver):
    """Capacitors: one number, or one for each port.

    Their impedance is Z = 1 / (i w C); luseepy's ``IdealCapacitorReceiver``.

    Attributes
    ----------
    capacitance_pf : tuple of float
        Capacitance.
    """

    luseepy_name: ClassVar[str] = "IdealCapacitorReceiver"
    luseepy_parameters: ClassVar[dict[str, str]] = {"C_pf": "capacitance_pf"}

    model: Literal["capacitor"] = "capacitor"
    capacitance_pf: _ports(Positive) = (30.0, 30.0, 30.0, 30.0)

    def load(self, frequency_mhz: float) -> Ohms:
        return np.diag(1.0 / (2.0e-6j * np.pi * frequency_mhz * np.array(self.capacitance_pf)))


@dataclass(frozen=True)
class MeasuredReceiver(Receiver):
    """Loads from a measurement or from a data file; they may couple the ports.

    Attributes
    ----------
    path : str
        The file, for error messages.
    frequencies_mhz : (frequencies,) array
    load_ohm : (frequencies, ports, ports) complex array
        ZL; interpolated linearly between these frequencies, as in luseepy.
    """

    luseepy_name: ClassVar[str] = "MeasuredReceiver"

    path: str
    frequencies_mhz: Float[np.ndarray, " frequencies"]
    load_ohm: Complex[np.ndarray, "frequencies ports ports"]

    def load(self, frequency_mhz: float) -> Ohms:
        mhz = self.frequencies_mhz
        return beam_fields.at_frequency(self.path, mhz, frequency_mhz, self.load_ohm)[0]


def receiver_of(
    path: str | Path, arrays: Mapping[str, np.ndarray], mhz: str, real: str, imaginary: str
) -> MeasuredReceiver | None:
    """Return the loads from a file's arrays with these names; None if it has none."""
    if not {mhz, real, imaginary} <= set(arrays):
        return None
    return MeasuredReceiver(str(path), arrays[mhz], arrays[real] + 1j * arrays[imaginary])


def read_receiver(path: str | Path) -> MeasuredReceiver:
    """Read loads from a FITS file with the images ``freq`` (MHz), ``ZL_real``, ``ZL_imag`` (Ohm).

    Parameters
    ----------
    path : str or Path
        For instance a four-port waterfall.

    Returns
    -------
    MeasuredReceiver

    Raises
    ------
    InputError
        For a missing or damaged file, or one without such images.
    """
    images = formats.read_fits(path, LOADS_LAYOUT, "check beam.receiver").arrays
    return receiver_of(path, images, "freq", *LOADS)


class ReceiverFileSection(Section):
    """Load impedances from a file with images ``freq``, ``ZL_real`` and ``ZL_imag``.

    Attributes
    ----------
    file : str
        Path of the file.
    """

    model: Literal["file"] = "file"
    file: str

    def receiver(self) -> Receiver | None:
        """The receiver, or None for open ports."""
        return read_receiver(self.file)


class OpenSection(Section):
    """Open ports: no receiver connected."""

    model: Literal["open"] = "open"

    def receiver(self) -> Receiver | None:
        """The receiver, or None for open ports."""
        return None


def _named(value: Any) -> Any:
    """``receiver: open`` means ``receiver: {model: open}``."""
    return {"model": value} if isinstance(value, str) else value


ReceiverSection = Annotated[
    JFETReceiver | CapacitorReceiver | ReceiverFileSection | OpenSection,
    Field(discriminator="model"),
    BeforeValidator(_named),
]


@dataclass(frozen=True)
class Circuit:
    """Antennas with their losses, and receivers.

    Attributes
    ----------
    frequency_mhz : float
    antenna_ohm : (ports, ports) complex array
        ZA.
    moon_ohm, loss_ohm : (ports, ports) complex array
        Resistive parts of ZA: radiation into the Moon, losses in the antennas.
    receiver : Receiver or None
        None for open ports.
    """

    frequency_mhz: float
    antenna_ohm: Ohms
    moon_ohm: Ohms
    loss_ohm: Ohms
    receiver: Receiver | None

    @property
    def load_ohm(self) -> Ohms | None:
        """ZL; None for open ports."""
        return None if self.receiver is None else self.receiver.load(self.frequency_mhz)

    @property
    def resistance_ohm(self) -> Ohms:
        """The whole resistive part, (ZA + ZA^H) / 2."""
        return (self.antenna_ohm + self.antenna_ohm.conj().T) / 2.0

    @property
    def loading(self) -> Ohms:
        """M = ZL (ZA + ZL)^-1; the identity for open ports."""
        if (load_ohm := self.load_ohm) is None:
            return np.eye(len(self.antenna_ohm), dtype=complex)
        return np.linalg.solve((self.antenna_ohm + load_ohm).T, load_ohm.T).T

    @property
    def per_kelvin(self) -> Ohms:
        """U = 4 k M (ZA + ZA^H) / 2 M^H, the V^2/Hz in an enclosure at 1 K."""
        return self.emitted(self.resistance_ohm)

    def emitted(self, kelvin_ohm: Ohms) -> Ohms:
        """Return the V^2/Hz at the receivers, from resistances times their temperatures in K."""
        return 4.0 * Boltzmann * self.loading @ kelvin_ohm @ self.loading.conj().T


class Parameter(NamedTuple):
    """A parameter of antennas.

    Attributes
    ----------
    value : () array
        Present value, in the unit at the end of the parameter's name.
    low, high : float
        Ends of its domain.
    """

    value: float | Float[Array, ""]
    low: float = -np.inf
    high: float = np.inf


class BeamSource(ABC):
    """The antennas of an instrument at every frequency, and the ground emission they receive.

    Frame: topocentric at turntable angle zero, theta from the zenith, phi from East towards North.
    """

    @property
    @abstractmethod
    def n_ports(self) -> int:
        """Number of ports; there are n_ports^2 real products."""

    # whether fields of antennas are available, not only beams of products
    has_fields = True

    @abstractmethod
    def fields(
        self, frequency_mhz: float, grid: beam_fields.HemisphereGrid
    ) -> beam_fields.AntennaFields:
        """Return the field patterns of all ports on a grid.

        Parameters
        ----------
        frequency_mhz : float
        grid : HemisphereGrid

        Returns
        -------
        AntennaFields
            In one unit for all directions; its products are proportional to :meth:`beams`.

        Raises
        ------
        InputError
            If the source has no beams at this frequency, or no fields of antennas.
        """

    def patterns(self, frequency_mhz: float, grid: beam_fields.HemisphereGrid) -> beam_fields.Pairs:
        """Return the response of every pair to Stokes I on a grid, in the unit of :meth:`fields`.

        Raises
        ------
        InputError
            If the source has no beams at this frequency.
        """
        return beam_fields.stokes_beam(self.fields(frequency_mhz, grid))

    def pattern_scale(self, frequency_mhz: float) -> float:
        """Return the factor that turns :meth:`patterns` into beams in K per K, in 1/sr."""
        whole, autos = beam_fields.HemisphereGrid.for_lmax(0), auto_indices(self.n_ports)
        patterns = np.asarray(to_real(self.patterns(frequency_mhz, whole)))
        modes = np.asarray(self.beams(frequency_mhz, 0).modes)
        return float(modes[autos, 0].mean() / whole.modes(patterns, 0)[autos].mean())

    def response(
        self, frequency_mhz: float, directions: Float[Array, "directions 3"], stokes: str = "I"
    ) -> Float[Array, "products directions"]:
        """Return the beams B_k(n) in directions n, where a source of 1 K sr adds B_k(n) kelvin.

        By cubic splines of the patterns on a grid of half a degree.

        Parameters
        ----------
        frequency_mhz : float
        directions : (directions, 3) array
            Unit vectors: East, North, up in the frame of the antennas.
        stokes : {"I", "Q", "U", "V"}

        Returns
        -------
        (products, directions) array
            In 1/sr; zero where up <= 0.

        Raises
        ------
        InputError
            As :meth:`patterns`, or :meth:`fields` unless ``stokes`` is "I".
        """
        east, north, up = np.asarray(directions).T
        at = np.arctan2(np.hypot(east, north), up), np.arctan2(north, east) % (2.0 * np.pi)
        splines = _splines(self, frequency_mhz, stokes)
        seen = np.stack([spline(*at, grid=False) for spline in splines])
        return np.where(up > 0.0, seen, 0.0)

    @abstractmethod
    def beams(self, frequency_mhz: float, lmax: int) -> beam_fields.ProductBeams:
        """Return the beams of all products.

        Parameters
        ----------
        frequency_mhz : float
        lmax : int
            Highest ell of the coefficients.

        Returns
        -------
        ProductBeams
            In K per K.

        Raises
        ------
        InputError
            If the source has no beams at this frequency.
        """

    def background(self, frequency_mhz: float) -> Float[Array, " products"]:
        """Return the visibilities without any sky: emission of the ground and of lossy antennas.

        Parameters
        ----------
        frequency_mhz : float

        Returns
        -------
        (products,) array
            In K; zeros if nothing emits.

        Raises
        ------
        InputError
            If the source emits but has no beams at this frequency.
        """
        return np.zeros(self.n_ports**2)

    def impedance(self, frequency_mhz: float) -> complex | None:
        """Return the impedance of one arm in Ohm; None if it is unknown.

        Raises
        ------
        InputError
            If the source has impedances, but not at this frequency.
        """
        return None

    def circuit(self, frequency_mhz: float) -> Circuit | None:
        """Return the antennas' impedances and their receivers; None for a source without volts.

        Raises
        ------
        InputError
            If the source has volts, but not at this frequency.
        """
        return None

    def interpolated(self, frequency_mhz: float) -> beam_fields.Interpolation | None:
        """Return how beams are interpolated to this frequency; None if they are not.

        Raises
        ------
        InputError
            If the source has no beams at this frequency.
        """
        return None

    def behind(self, receiver: Receiver | None) -> BeamSource:
        """Return the source with the receivers that data state, unless the source fixes its own."""
        return self

    def parameters(self) -> Mapping[str, Parameter]:
        """Return the antennas' adjustable parameters, by name; there are none for a file's."""
        return {}

    def parameter(self, name: str) -> Parameter:
        """Return the parameter of this name.

        Raises
        ------
        InputError
            If there is no such parameter; the message gives the nearest name.
        """
        parameters = self.parameters()
        require_known("unknown beam parameter", name, parameters)
        return parameters[name]

    def with_values(self, values: Values) -> BeamSource:
        """Return the antennas with other values of the named parameters, differentiably.

        Raises
        ------
        InputError
            If a name is unknown, or a value outside the source's range.
        """
        for name in values:
            self.parameter(name)
        return self

    def interpolation_errors(self, frequency_mhz: float, lmax: int) -> Mapping[str, Lines]:
        """Return errors of beams that are interpolated in parameters, by the node of each."""
        return {}


@lru_cache(maxsize=4)
def _splines(source: BeamSource, frequency_mhz: float, stokes: str) -> list[Any]:
    """Splines of the beams of all products in theta and phi, in 1/sr."""
    theta = np.linspace(0.0, np.pi / 2.0, N_FINE)
    grid = beam_fields.HemisphereGrid(theta, np.zeros(N_FINE), N_PHI)
    patterns = source.patterns(frequency_mhz, grid)
    if stokes != "I":
        patterns = beam_fields.stokes_beam(source.fields(frequency_mhz, grid), stokes)
    beams = np.asarray(to_real(patterns)) * source.pattern_scale(frequency_mhz)
    around = np.pad(beams, ((0, 0), (0, 0), (MARGIN, MARGIN)), "wrap")
    phi = 2.0 * np.pi / N_PHI * np.arange(-MARGIN, N_PHI + MARGIN)
    return [lazy.interpolate.RectBivariateSpline(theta, phi, one) for one in around]
