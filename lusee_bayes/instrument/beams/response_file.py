"""Coupled antennas over ground, with their receivers, from the four-port files of luseepy.

FITS version 3: bare effective lengths H_theta, H_phi (port, frequency, theta, phi) in m, RMS, of a
wave arriving from (theta, phi), phi from East towards North; impedance ZA and its resistive parts
Rsky, Rmoon, Rloss (frequency, port, port) in Ohm, with ZA + ZA^H = 2 (Rsky + Rmoon + Rloss); freq
in MHz, theta and phi in degrees. At the receivers' inputs, one-sided, ::

    V_ab = k eta0 / lambda^2 int (M Ht)_a conj((M Ht)_b) + (M Hp)_a conj((M Hp)_b) T dOmega
           + 4 k (M (T_moon Rmoon + T_antenna Rloss) M^H)_ab    in V^2/Hz.

An enclosure of 1 K makes U = 4 k M (ZA + ZA^H) / 2 M^H; V_ab / sqrt(U_aa U_bb) is in K. Between the
frequencies of the file luseepy interpolates impedances and the integrals of open ports (M left out)
linearly, and takes M of the interpolated ZA.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Complex, Float
from scipy.constants import Boltzmann, physical_constants

from lusee_bayes.core.arrays import Array
from lusee_bayes.core.errors import InputError, nearest
from lusee_bayes.core.formats import read_fits
from lusee_bayes.core.layouts import Attribute, Layout, Variable
from lusee_bayes.instrument.beams.circuit import Circuit
from lusee_bayes.instrument.beams.fields import SPEED_OF_LIGHT, AntennaFields
from lusee_bayes.instrument.beams.grid import HemisphereGrid
from lusee_bayes.instrument.beams.gridded import (
    Interpolation,
    at_frequency,
    neighbours,
    on_grid,
)
from lusee_bayes.instrument.beams.luseepy_rules import BandLimitedGrid
from lusee_bayes.instrument.beams.luseepy_words import CONVENTIONS, SOURCES, require_conventions
from lusee_bayes.instrument.beams.product_beams import ProductBeams, product_modes
from lusee_bayes.instrument.beams.receiver import JFETReceiver, Receiver
from lusee_bayes.instrument.products import N_ANTENNAS, to_matrix, to_real

VACUUM_OHM = physical_constants["characteristic impedance of vacuum"][0]
LENGTHS = ("H_theta", "H_phi")
MATRICES = ("ZA", "Rsky", "Rmoon", "Rloss")
AXES = ("freq", "theta", "phi")
PARTS = ("real", "imag")
LAYOUT = Layout(
    "a four-port response of luseepy, FITS version 3",
    {
        "freq": Variable(("freq",), low=0.0, grows=True, unit="MHz"),
        **{name: Variable((name,), grows=True, unit="deg") for name in AXES[1:]},
        **{
            f"{name}_{part}": Variable((N_ANTENNAS, *AXES), unit="m")
            for name in LENGTHS
            for part in PARTS
        },
        **{
            f"{name}_{part}": Variable(("freq", N_ANTENNAS, N_ANTENNAS), unit="Ohm")
            for name in MATRICES
            for part in PARTS
        },
    },
    dict.fromkeys((*CONVENTIONS, *SOURCES), Attribute("word", optional=True)),
)
# files hold the matrices in single precision; three of them are added up
RESISTANCE_TOLERANCE = 1e-6
UNITS = ("K", "V2/Hz")
Unit = Literal["K", "V2/Hz"]


@dataclass(frozen=True)
class PortResponse:
    """Coupled antennas at several frequencies.

    Attributes
    ----------
    path : str
        The file, for error messages.
    frequencies_mhz : (frequencies,) array
    theta : (theta,) array
        From 0 to pi / 2 in equal steps; azimuths are 2 pi k / n_phi.
    h_theta, h_phi : (frequencies, ports, theta, phi) complex array
        Effective lengths in m.
    impedance : (frequencies, ports, ports) complex array
        ZA in Ohm.
    moon_resistance, loss_resistance : (frequencies, ports, ports) complex array
        Rmoon and Rloss in Ohm.
    receiver : Receiver or None
        What is connected to the ports; None leaves them open.
    interpolation : {"linear", "spline"}
        Between the frequencies: luseepy's rule, impedances and products of fields linearly, or
        cubic splines through impedances and fields.
    """

    path: str
    frequencies_mhz: Float[np.ndarray, " frequencies"]
    theta: Float[np.ndarray, " theta"]
    h_theta: Complex[np.ndarray, "frequencies ports theta phi"]
    h_phi: Complex[np.ndarray, "frequencies ports theta phi"]
    impedance: Complex[np.ndarray, "frequencies ports ports"]
    moon_resistance: Complex[np.ndarray, "frequencies ports ports"]
    loss_resistance: Complex[np.ndarray, "frequencies ports ports"]
    receiver: Receiver | None = JFETReceiver()
    interpolation: Interpolation = "linear"

    @property
    def n_phi(self) -> int:
        """Number of azimuths."""
        return self.h_theta.shape[3]

    @property
    def luseepy_grid(self) -> BandLimitedGrid:
        """The directions of the file with the rule of luseepy's four-port engine."""
        return BandLimitedGrid.of(self.theta, self.n_phi)

    def circuit(self, frequency_mhz: float) -> Circuit:
        """Return antennas and receivers. InputError outside the frequencies of the file."""
        parts = (self.impedance, self.moon_resistance, self.loss_resistance)
        return Circuit(frequency_mhz, *self._at(frequency_mhz, *parts), self.receiver)

    def per_kelvin(self, frequency_mhz: float) -> Float[np.ndarray, " ports"]:
        """Return U_aa, the V^2/Hz that an enclosure of 1 K makes at each receiver's input."""
        return self.circuit(frequency_mhz).per_kelvin.diagonal().real

    def fields(
        self,
        frequency_mhz: float,
        *,
        grid: HemisphereGrid | None = None,
        turn_deg: float = 0.0,
        unit: Unit = "K",
    ) -> AntennaFields:
        """Return the fields of the ports; their products are beams in ``unit`` per K and sr.

        Between the frequencies of the file this is so with splines only. With linear interpolation
        the fields themselves are interpolated here, for pictures; use :meth:`beams` for products.

        Parameters
        ----------
        frequency_mhz : float
        grid : HemisphereGrid, optional
            By default nodes that integrate across the horizon exactly; ``luseepy_grid`` is the
            rule of luseepy.
        turn_deg : float
            How far the instrument is turned, from East towards North.
        unit : {"K", "V2/Hz"}
            V^2/Hz are those at the receivers' inputs.

        Returns
        -------
        AntennaFields

        Raises
        ------
        InputError
            Outside the frequencies of the file, or for an unknown unit.
        """
        opened = self._open(self._at(frequency_mhz, self.h_theta, self.h_phi), grid, turn_deg)
        mixing = self._mixing(frequency_mhz, unit) / (SPEED_OF_LIGHT / (1e6 * frequency_mhz))
        parts = (np.tensordot(mixing, part, axes=1) for part in (opened.e_theta, opened.e_phi))
        return AntennaFields(*parts, opened.grid)

    def beams(
        self,
        frequency_mhz: float,
        lmax: int,
        *,
        grid: HemisphereGrid | None = None,
        turn_deg: float = 0.0,
        unit: Unit = "K",
    ) -> ProductBeams:
        """Return the beams of all products, in ``unit`` per K; arguments as of :meth:`fields`."""
        if self.interpolation == "spline":
            fields = self.fields(frequency_mhz, grid=grid, turn_deg=turn_deg, unit=unit)
            modes = product_modes(fields, lmax, normalise=False)
            return ProductBeams(modes, float(frequency_mhz))
        opened = np.zeros((N_ANTENNAS**2, (lmax + 1) ** 2))
        for k, weight in neighbours(self.path, self.frequencies_mhz, frequency_mhz):
            fields = self._open([self.h_theta[k], self.h_phi[k]], grid, turn_deg)
            wavelength = SPEED_OF_LIGHT / (1e6 * self.frequencies_mhz[k])
            opened += weight / wavelength**2 * product_modes(fields, lmax, normalise=False)
        mixing = self._mixing(frequency_mhz, unit)
        seen = np.einsum("ai,ijm,bj->abm", mixing, to_matrix(opened), mixing.conj(), optimize=True)
        return ProductBeams(to_real(seen), float(frequency_mhz))

    def background(
        self,
        frequency_mhz: float,
        moon_k: float,
        antenna_k: float = 0.0,
        *,
        unit: Unit = "K",
    ) -> Float[Array, " products"]:
        """Return the visibilities without any sky: what the Moon and lossy antennas emit.

        Parameters
        ----------
        frequency_mhz : float
        moon_k, antenna_k : float
            Temperatures of the Moon and of the antennas in K.
        unit : {"K", "V2/Hz"}

        Returns
        -------
        (products,) array

        Raises
        ------
        InputError
            Outside the frequencies of the file.
        """
        circuit = self.circuit(frequency_mhz)
        seen = circuit.emitted(moon_k * circuit.moon_ohm + antenna_k * circuit.loss_ohm)
        if unit == "K":
            root = np.sqrt(self.per_kelvin(frequency_mhz))
            seen = seen / (root[:, None] * root[None])
        return to_real(seen)

    def _at(self, frequency_mhz: float, *parts: np.ndarray) -> list[np.ndarray]:
        return at_frequency(
            self.path,
            self.frequencies_mhz,
            frequency_mhz,
            *parts,
            interpolation=self.interpolation,
        )

    def _mixing(self, frequency_mhz: float, unit: str) -> Complex[np.ndarray, "ports ports"]:
        """M, scaled such that products of open ports' fields / wavelength become beams."""
        if unit not in UNITS:
            raise InputError(f"unknown unit '{unit}'; {nearest(unit, UNITS)}")
        # product beams are halves of the sums over polarisations
        scale = np.full(N_ANTENNAS, np.sqrt(2.0 * Boltzmann * VACUUM_OHM))
        if unit == "K":
            scale = scale / np.sqrt(self.per_kelvin(frequency_mhz))
        return scale[:, None] * self.circuit(frequency_mhz).loading

    def _open(
        self, parts: list[np.ndarray], grid: HemisphereGrid | None, turn_deg: float
    ) -> AntennaFields:
        """The effective lengths of one frequency on a grid, of ports that are open."""
        if grid is None:
            grid = HemisphereGrid.gauss_legendre(2 * len(self.theta), self.n_phi)
        turned = (np.stack([on_grid(h, self.theta, grid, turn_deg) for h in p]) for p in parts)
        return AntennaFields(*turned, grid)


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
        For a missing or truncated file, a missing image, shapes that do not fit, directions other
        than the hemisphere above the horizon, frequencies that do not grow, numbers that are not
        finite, resistances that do not add up, or a header that states other conventions.
    """
    found = read_fits(path, LAYOUT, "check beam.file")
    require_conventions(path, found.values)
    images = found.arrays
    frequencies, theta_deg, phi_deg = (images[name] for name in AXES)
    for name, degrees, last in (("theta", theta_deg, 90.0), ("phi", phi_deg, 360.0)):
        if not np.allclose(degrees, np.linspace(0.0, last, len(degrees)), rtol=0, atol=1e-9):
            raise InputError(
                f"{path}: {name} goes from {degrees[0]:g} to {degrees[-1]:g} degrees; expected "
                f"equal steps from 0 to {last:g}"
            )
    complex_ = {n: images[f"{n}_real"] + 1j * images[f"{n}_imag"] for n in (*LENGTHS, *MATRICES)}
    # the last azimuth is the first once more
    h_theta, h_phi = (np.moveaxis(complex_[name], 0, 1)[..., :-1] for name in LENGTHS)
    impedance, sky, moon, loss = (complex_[name] for name in MATRICES)
    resistance = (impedance + impedance.conj().swapaxes(1, 2)) / 2.0
    off = np.abs(sky + moon + loss - resistance).max() / np.abs(resistance).max()
    if off > RESISTANCE_TOLERANCE:
        raise InputError(
            f"{path}: Rsky + Rmoon + Rloss differ from (ZA + ZA^H) / 2 by {off:.1g} of the "
            "largest; expected equality"
        )
    theta = np.linspace(0.0, np.pi / 2.0, len(theta_deg))
    return PortResponse(str(path), frequencies, theta, h_theta, h_phi, impedance, moon, loss)
