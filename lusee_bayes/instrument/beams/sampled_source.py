"""Sampled beams as a source of beams."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Complex, Float

from lusee_bayes.core.arrays import Array
from lusee_bayes.instrument.beams.fields import AntennaFields
from lusee_bayes.instrument.beams.grid import HemisphereGrid
from lusee_bayes.instrument.beams.product_beams import ProductBeams
from lusee_bayes.instrument.beams.sampled import SampledBeams
from lusee_bayes.instrument.beams.source import BeamSource


@dataclass(frozen=True, eq=False)
class SampledFileBeams(BeamSource):
    """Fields of antennas or beams of products that are sampled in directions; nothing emits.

    Attributes
    ----------
    sampled : SampledBeams
    turntable_offset_deg : float
        How much further the turntable is than it says, from East towards North.
    normalise : bool or None
        Scale the beams so that autos integrate to one on average; None for as the file says.
    """

    sampled: SampledBeams
    turntable_offset_deg: float = 0.0
    normalise: bool | None = None

    @property
    def n_ports(self) -> int:
        return self.sampled.n_ports

    @property
    def emits(self) -> bool:
        return False

    def fields(self, frequency_mhz: float, grid: HemisphereGrid) -> AntennaFields:
        return self.sampled.fields(frequency_mhz, grid, self.turntable_offset_deg)

    def patterns(
        self, frequency_mhz: float, grid: HemisphereGrid
    ) -> Complex[Array, "antennas antennas theta phi"]:
        return self.sampled.patterns(frequency_mhz, grid, self.turntable_offset_deg)

    def beams(self, frequency_mhz: float, lmax: int) -> ProductBeams:
        return self.sampled.beams(
            frequency_mhz,
            lmax,
            turn_deg=self.turntable_offset_deg,
            normalise=self.normalise,
        )

    def background(self, frequency_mhz: float) -> Float[Array, " products"]:
        return np.zeros(self.n_ports**2)
