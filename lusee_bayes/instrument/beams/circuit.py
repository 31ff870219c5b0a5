"""Coupled antennas and their receivers as a circuit, at one frequency.

Antennas of impedance matrix ZA with open-circuit voltages v make the voltages M v at the inputs of
receivers of impedance ZL (Thevenin's theorem), M = ZL (ZA + ZL)^-1.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Complex
from scipy.constants import Boltzmann

from lusee_bayes.instrument.beams.receiver import Receiver


@dataclass(frozen=True)
class Circuit:
    """Antennas, what dissipates in them, and receivers.

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
    antenna_ohm: Complex[np.ndarray, "ports ports"]
    moon_ohm: Complex[np.ndarray, "ports ports"]
    loss_ohm: Complex[np.ndarray, "ports ports"]
    receiver: Receiver | None

    @property
    def load_ohm(self) -> Complex[np.ndarray, "ports ports"] | None:
        """ZL; None for open ports."""
        return None if self.receiver is None else self.receiver.load(self.frequency_mhz)

    @property
    def resistance_ohm(self) -> Complex[np.ndarray, "ports ports"]:
        """The whole resistive part, (ZA + ZA^H) / 2."""
        return (self.antenna_ohm + self.antenna_ohm.conj().T) / 2.0

    @property
    def loading(self) -> Complex[np.ndarray, "ports ports"]:
        """M; the identity for open ports."""
        return loading_matrix(self.antenna_ohm, self.load_ohm)

    @property
    def per_kelvin(self) -> Complex[np.ndarray, "ports ports"]:
        """U = 4 k M (ZA + ZA^H) / 2 M^H, the V^2/Hz that an enclosure of 1 K makes."""
        return self.emitted(self.resistance_ohm)

    def emitted(
        self, kelvin_ohm: Complex[np.ndarray, "ports ports"]
    ) -> Complex[np.ndarray, "ports ports"]:
        """Return the V^2/Hz at the receivers of resistances times their temperatures in K."""
        return 4.0 * Boltzmann * self.loading @ kelvin_ohm @ self.loading.conj().T


def loading_matrix(
    antenna_ohm: Complex[np.ndarray, "ports ports"],
    load_ohm: Complex[np.ndarray, "ports ports"] | None,
) -> Complex[np.ndarray, "ports ports"]:
    """Return M = ZL (ZA + ZL)^-1; the identity for open ports (``load_ohm`` None)."""
    if load_ohm is None:
        return np.eye(len(antenna_ohm), dtype=complex)
    return np.linalg.solve((antenna_ohm + load_ohm).T, load_ohm.T).T
