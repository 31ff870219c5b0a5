"""Where the beams of an instrument come from: the embedded antennas, or a file of luseepy.

Every kind is one :class:`BeamSource`; what uses beams asks nothing about the kind. A new kind
is one class here and one line in the test of the contract,
:func:`lusee_bayes.testing.check_beam_source`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Complex, Float

from lusee_bayes.core.arrays import Array
from lusee_bayes.core.errors import InputError
from lusee_bayes.instrument.beams.fields import (
    AntennaFields,
    HemisphereGrid,
    Interpolation,
    ProductBeams,
    stokes_beam,
)
from lusee_bayes.instrument.beams.luseepy_files import ROTATIONS_DEG, PortResponse, ScalarBeam
from lusee_bayes.instrument.beams.monopoles import Circuit, Monopoles, Receiver, monopole_beams
from lusee_bayes.instrument.products import N_ANTENNAS


class BeamSource(ABC):
    """The antennas of an instrument at every frequency, and what they receive from the ground.

    Frame: topocentric at turntable angle zero, theta from the zenith, phi from East towards North.
    """

    @property
    @abstractmethod
    def n_ports(self) -> int:
        """Number of ports; there are n_ports^2 real products."""

    @property
    def emits(self) -> bool:
        """Whether ground or antennas emit, so that :meth:`background` is not zero."""
        return False

    @abstractmethod
    def fields(self, frequency_mhz: float, grid: HemisphereGrid) -> AntennaFields:
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

    def patterns(
        self, frequency_mhz: float, grid: HemisphereGrid
    ) -> Complex[Array, "antennas antennas theta phi"]:
        """Return the response of every pair to Stokes I on a grid, in the unit of :meth:`fields`.

        Raises
        ------
        InputError
            If the source has no beams at this frequency.
        """
        return stokes_beam(self.fields(frequency_mhz, grid))

    @abstractmethod
    def beams(self, frequency_mhz: float, lmax: int) -> ProductBeams:
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
        """Return the visibilities without any sky: what the ground and lossy antennas emit.

        Parameters
        ----------
        frequency_mhz : float

        Returns
        -------
        (products,) array
            In K; zeros where nothing emits.

        Raises
        ------
        InputError
            If the source emits but has no beams at this frequency.
        """
        return np.zeros(self.n_ports**2)

    def impedance(self, frequency_mhz: float) -> complex | None:
        """Return the impedance of one arm in Ohm; None where it is not known.

        Raises
        ------
        InputError
            If the source has impedances, but not at this frequency.
        """
        return None

    def circuit(self, frequency_mhz: float) -> Circuit | None:
        """Return the antennas' impedances and their receivers; None if the source knows no volts.

        Raises
        ------
        InputError
            If the source knows volts, but not at this frequency.
        """
        return None

    def interpolated(self, frequency_mhz: float) -> Interpolation | None:
        """Return how beams are interpolated to this frequency; None where they are not.

        Raises
        ------
        InputError
            If the source has no beams at this frequency.
        """
        return None

    def behind(self, receiver: Receiver | None) -> BeamSource:
        """Return the source with the receivers of data, where they and nothing else say them."""
        return self

    @property
    def monopoles(self) -> Monopoles:
        """The embedded antennas. InputError where the beams are those of a file."""
        raise InputError(
            "this needs the embedded antennas, which beam.file replaces; leave out beam.file"
        )


@dataclass(frozen=True, eq=False)
class EmbeddedBeams(BeamSource):
    """The package's own antennas; their beams are scaled to the sky alone.

    Attributes
    ----------
    antennas : Monopoles
    """

    antennas: Monopoles

    @property
    def n_ports(self) -> int:
        return self.antennas.azimuths_deg.size

    def fields(self, frequency_mhz: float, grid: HemisphereGrid) -> AntennaFields:
        return self.antennas.fields(frequency_mhz, grid)

    def beams(self, frequency_mhz: float, lmax: int) -> ProductBeams:
        return monopole_beams(frequency_mhz, lmax, self.antennas)

    @property
    def monopoles(self) -> Monopoles:
        return self.antennas


@dataclass(frozen=True, eq=False)
class ScalarFileBeams(BeamSource):
    """One arm from a scalar beam file, at several azimuths; nothing couples the arms.

    Attributes
    ----------
    beam : ScalarBeam
    turntable_offset_deg : float
        How much further the turntable is than it says, from East towards North.
    taper : bool
        Fade out towards the horizon as luseepy does.
    rotations_deg : tuple of float
        How far the pattern is turned for each port, from East towards North.
    luseepy_quadrature : bool
        Integrate with luseepy's own rule, for data that luseepy has made.
    moon_k : float
        Temperature of the ground in K.
    """

    beam: ScalarBeam
    turntable_offset_deg: float = 0.0
    taper: bool = True
    rotations_deg: tuple[float, ...] = ROTATIONS_DEG
    luseepy_quadrature: bool = False
    moon_k: float = 0.0

    @property
    def n_ports(self) -> int:
        return len(self.rotations_deg)

    @property
    def emits(self) -> bool:
        return self.moon_k != 0.0

    def fields(self, frequency_mhz: float, grid: HemisphereGrid) -> AntennaFields:
        return self.beam.fields(frequency_mhz, **(self._placement | {"grid": grid}))

    def beams(self, frequency_mhz: float, lmax: int) -> ProductBeams:
        return self.beam.beams(frequency_mhz, lmax, **self._placement)

    def background(self, frequency_mhz: float) -> Float[Array, " products"]:
        if not self.emits:
            return super().background(frequency_mhz)
        return self.beam.background(frequency_mhz, self.moon_k, **self._placement)

    def impedance(self, frequency_mhz: float) -> complex | None:
        return self.beam.impedance_at(frequency_mhz)

    def interpolated(self, frequency_mhz: float) -> Interpolation | None:
        return self.beam.interpolated(frequency_mhz)

    @property
    def _placement(self) -> dict[str, Any]:
        grid = self.beam.luseepy_grid if self.luseepy_quadrature else None
        rotations = tuple(angle + self.turntable_offset_deg for angle in self.rotations_deg)
        return {"grid": grid, "taper": self.taper, "rotations_deg": rotations}


@dataclass(frozen=True, eq=False)
class ResponseBeams(BeamSource):
    """Four coupled ports from a response file, with their receivers.

    Attributes
    ----------
    response : PortResponse
    turntable_offset_deg : float
        How much further the turntable is than it says, from East towards North.
    luseepy_quadrature : bool
        Integrate with luseepy's own rule, for data that luseepy has made.
    moon_k, antenna_k : float
        Temperatures of the ground and of the lossy antennas in K.
    receiver_said : bool
        Whether the response's receivers are to be used for all data; else those that data say.
    """

    response: PortResponse
    turntable_offset_deg: float = 0.0
    luseepy_quadrature: bool = False
    moon_k: float = 0.0
    antenna_k: float = 0.0
    receiver_said: bool = True

    @property
    def n_ports(self) -> int:
        return N_ANTENNAS

    @property
    def emits(self) -> bool:
        return self.moon_k != 0.0 or self.antenna_k != 0.0

    def fields(self, frequency_mhz: float, grid: HemisphereGrid) -> AntennaFields:
        return self.response.fields(frequency_mhz, grid=grid, turn_deg=self.turntable_offset_deg)

    def beams(self, frequency_mhz: float, lmax: int) -> ProductBeams:
        grid = self.response.luseepy_grid if self.luseepy_quadrature else None
        turn_deg = self.turntable_offset_deg
        return self.response.beams(frequency_mhz, lmax, grid=grid, turn_deg=turn_deg)

    def background(self, frequency_mhz: float) -> Float[Array, " products"]:
        if not self.emits:
            return super().background(frequency_mhz)
        return self.response.background(frequency_mhz, self.moon_k, self.antenna_k)

    def interpolated(self, frequency_mhz: float) -> Interpolation | None:
        return self.response.interpolated(frequency_mhz)

    def behind(self, receiver: Receiver | None) -> BeamSource:
        if receiver is None or self.receiver_said:
            return self
        return replace(self, response=replace(self.response, receiver=receiver))

    def circuit(self, frequency_mhz: float) -> Circuit:
        return self.response.circuit(frequency_mhz)
