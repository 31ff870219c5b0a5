"""The embedded instrument as a function of its parameters: A(permittivity, tilt, ...)."""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from lusee_bayes.beams import Monopoles, monopole_beams
from lusee_bayes.coupling import CouplingMatrix
from lusee_bayes.layout import DataLayout
from lusee_bayes.noise.beam_error import placed
from lusee_bayes.pointing import Pointing


class Instrument(eqx.Module):
    """Embedded antennas on a turntable, observing; what a program varies to learn about them.

    monopoles : the nominal antennas; pointing : orientations; layout : which samples there are.
    """

    monopoles: Monopoles
    pointing: Pointing
    layout: DataLayout
    frequency_mhz: float = eqx.field(static=True)
    lmax: int = eqx.field(static=True)

    def coupling(
        self, *, turntable_offset_deg: Float[Array, ""] | float = 0.0, **parameters: Array
    ) -> CouplingMatrix:
        """A with parameters of the antennas set to given values, differentiably.

        parameters : of ``noise.beam_error.PARAMETERS`` (surface_permittivity, deep_permittivity,
        loss_tangent, zenith_angle_deg, length_m, height_m); those left out stay nominal.
        turntable_offset_deg : added to every run's angle. InputError for unknown names.
        """
        beams = monopole_beams(self.frequency_mhz, self.lmax, placed(self.monopoles, parameters))
        offset = jnp.radians(jnp.asarray(turntable_offset_deg, dtype=jnp.float64))
        pointing = eqx.tree_at(
            lambda p: p.turntable, self.pointing, self.pointing.turntable + offset
        )
        return CouplingMatrix.build(beams, pointing, self.layout)
