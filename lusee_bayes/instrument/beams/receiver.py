"""The receivers' input impedance ZL, of luseepy's models of receivers."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np
from jaxtyping import Complex, Float

from lusee_bayes.core.formats import read_fits
from lusee_bayes.core.layouts import Layout, Variable
from lusee_bayes.instrument.beams.gridded import at_frequency
from lusee_bayes.instrument.products import N_ANTENNAS

LOADS = ("ZL_real", "ZL_imag")
LAYOUT = Layout(
    "loads ZL of four receivers, as luseepy's four-port waterfalls hold them",
    {
        "freq": Variable(("freq",), low=0.0, grows=True, unit="MHz"),
        **{name: Variable(("freq", N_ANTENNAS, N_ANTENNAS), unit="Ohm") for name in LOADS},
    },
)


class Receiver(ABC):
    """What is connected to the ports.

    Attributes
    ----------
    luseepy_name : str
        Of the class that luseepy has for it.
    """

    luseepy_name: ClassVar[str]

    @abstractmethod
    def load(self, frequency_mhz: float) -> Complex[np.ndarray, "ports ports"]:
        """Return ZL in Ohm. InputError at a frequency that the receiver does not know."""

    @abstractmethod
    def luseepy_parameters(self) -> dict[str, tuple[float, ...]]:
        """Return what luseepy's class takes, by its names."""


@dataclass(frozen=True)
class JFETReceiver(Receiver):
    """The preamplifier of each port, by the circuit that its input impedance follows:

    ::

        Z = series + skin w^power + i w L + parallel / (1 + i w parallel C)

    Defaults are luseepy's fits to the four spare flight preamplifiers. Nothing couples them.

    Attributes
    ----------
    capacitance_pf, inductance_nh : (ports,) tuple of float
        C and L.
    parallel_ohm, series_ohm : (ports,) tuple of float
    skin_ohm, skin_power : (ports,) tuple of float
        Skin effect, with w in rad/s.
    """

    luseepy_name: ClassVar[str] = "JFETReceiver"

    capacitance_pf: tuple[float, ...] = (33.79, 35.32, 34.89, 36.85)
    inductance_nh: tuple[float, ...] = (35.0, 36.4, 34.7, 8.5)
    parallel_ohm: tuple[float, ...] = (1101e3, 331e3, 288e3, 375e3)
    series_ohm: tuple[float, ...] = (0.21, 2.16, 3.71, 1.65)
    skin_ohm: tuple[float, ...] = (5.2e-12, 6.9e-20, 2.2e-38, 1.9e-16)
    skin_power: tuple[float, ...] = (1.39, 2.26, 4.35, 1.88)

    def load(self, frequency_mhz: float) -> Complex[np.ndarray, "ports ports"]:
        w = 2.0e6 * np.pi * frequency_mhz
        parallel = np.array(self.parallel_ohm)
        z = np.array(self.series_ohm) + np.array(self.skin_ohm) * w ** np.array(self.skin_power)
        z = z + 1j * w * 1e-9 * np.array(self.inductance_nh)
        z = z + parallel / (1.0 + 1j * w * parallel * 1e-12 * np.array(self.capacitance_pf))
        return np.diag(z)

    def luseepy_parameters(self) -> dict[str, tuple[float, ...]]:
        return {
            "C_pf": self.capacitance_pf,
            "L_nh": self.inductance_nh,
            "Rp_ohm": self.parallel_ohm,
            "Rs_ohm": self.series_ohm,
            "a": self.skin_ohm,
            "n": self.skin_power,
        }


@dataclass(frozen=True)
class CapacitorReceiver(Receiver):
    """A capacitor at each port, Z = 1 / (i w C): luseepy's ``IdealCapacitorReceiver``.

    Attributes
    ----------
    capacitance_pf : (ports,) tuple of float
    """

    luseepy_name: ClassVar[str] = "IdealCapacitorReceiver"

    capacitance_pf: tuple[float, ...] = (30.0, 30.0, 30.0, 30.0)

    def load(self, frequency_mhz: float) -> Complex[np.ndarray, "ports ports"]:
        return np.diag(1.0 / (2.0e-6j * np.pi * frequency_mhz * np.array(self.capacitance_pf)))

    def luseepy_parameters(self) -> dict[str, tuple[float, ...]]:
        return {"C_pf": self.capacitance_pf}


@dataclass(frozen=True)
class MeasuredReceiver(Receiver):
    """Loads that were measured, or that a file of data holds; they may couple the ports.

    Attributes
    ----------
    path : str
        The file, for error messages.
    frequencies_mhz : (frequencies,) array
    load_ohm : (frequencies, ports, ports) complex array
        ZL; linear between these frequencies, as in luseepy.
    """

    luseepy_name: ClassVar[str] = "MeasuredReceiver"

    path: str
    frequencies_mhz: Float[np.ndarray, " frequencies"]
    load_ohm: Complex[np.ndarray, "frequencies ports ports"]

    def load(self, frequency_mhz: float) -> Complex[np.ndarray, "ports ports"]:
        (ohm,) = at_frequency(self.path, self.frequencies_mhz, frequency_mhz, self.load_ohm)
        return ohm

    def luseepy_parameters(self) -> dict[str, tuple[float, ...]]:
        return {}


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
        For a missing or damaged file, or one that has no such images.
    """
    images = read_fits(path, LAYOUT, "check beam.receiver").arrays
    return MeasuredReceiver(str(path), images["freq"], images["ZL_real"] + 1j * images["ZL_imag"])
