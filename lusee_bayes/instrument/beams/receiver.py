"""The receivers' input impedance, and the voltages at their inputs.

Antennas of impedance matrix ZA with open-circuit voltages v make the voltages M v at the inputs of
receivers of impedance ZL (Thevenin's theorem), M = ZL (ZA + ZL)^-1.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Complex


@dataclass(frozen=True)
class Receiver:
    """The preamplifier of each port, by the circuit that its input impedance follows:

    ::

        Z = series + skin w^power + i w L + parallel / (1 + i w parallel C)

    Defaults are luseepy's fits to the four spare flight preamplifiers.

    Attributes
    ----------
    capacitance_pf, inductance_nh : (ports,) tuple of float
        C and L.
    parallel_ohm, series_ohm : (ports,) tuple of float
    skin_ohm, skin_power : (ports,) tuple of float
        Skin effect, with w in rad/s.
    """

    capacitance_pf: tuple[float, ...] = (33.79, 35.32, 34.89, 36.85)
    inductance_nh: tuple[float, ...] = (35.0, 36.4, 34.7, 8.5)
    parallel_ohm: tuple[float, ...] = (1101e3, 331e3, 288e3, 375e3)
    series_ohm: tuple[float, ...] = (0.21, 2.16, 3.71, 1.65)
    skin_ohm: tuple[float, ...] = (5.2e-12, 6.9e-20, 2.2e-38, 1.9e-16)
    skin_power: tuple[float, ...] = (1.39, 2.26, 4.35, 1.88)

    def load(self, frequency_mhz: float) -> Complex[np.ndarray, "ports ports"]:
        """Return ZL in Ohm; diagonal, since nothing couples the preamplifiers."""
        w = 2.0e6 * np.pi * frequency_mhz
        parallel = np.array(self.parallel_ohm)
        z = np.array(self.series_ohm) + np.array(self.skin_ohm) * w ** np.array(self.skin_power)
        z = z + 1j * w * 1e-9 * np.array(self.inductance_nh)
        z = z + parallel / (1.0 + 1j * w * parallel * 1e-12 * np.array(self.capacitance_pf))
        return np.diag(z)


def loading_matrix(
    antenna_ohm: Complex[np.ndarray, "ports ports"],
    load_ohm: Complex[np.ndarray, "ports ports"] | None,
) -> Complex[np.ndarray, "ports ports"]:
    """Return M = ZL (ZA + ZL)^-1; the identity for open ports (``load_ohm`` None)."""
    if load_ohm is None:
        return np.eye(len(antenna_ohm), dtype=complex)
    return np.linalg.solve((antenna_ohm + load_ohm).T, load_ohm.T).T
