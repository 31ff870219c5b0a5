"""The parameters of the embedded antennas by name: where they are, and what they can be."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from lusee_bayes.beams.monopoles import Monopoles
from lusee_bayes.checks import InputError, nearest


@dataclass(frozen=True)
class Parameter:
    """Where a parameter is in the antennas, and the ends of its domain."""

    where: Callable[[Monopoles], Float[Array, ""]]
    low: float = -np.inf
    high: float = np.inf


PARAMETERS = {
    "length_m": Parameter(lambda m: m.length_m, low=0.0),
    "zenith_angle_deg": Parameter(lambda m: m.zenith_angle_deg, low=0.0, high=180.0),
    "height_m": Parameter(lambda m: m.height_m, low=0.0),
    "turntable_offset_deg": Parameter(lambda m: m.turntable_offset_deg),
    "surface_permittivity": Parameter(lambda m: m.regolith.surface_permittivity, low=1.0),
    "deep_permittivity": Parameter(lambda m: m.regolith.deep_permittivity, low=1.0),
    "loss_tangent": Parameter(lambda m: m.regolith.loss_tangent, low=0.0),
}


def parameter(name: str) -> Parameter:
    """The parameter of this name. InputError naming the nearest for unknown ones."""
    if name not in PARAMETERS:
        raise InputError(f"unknown beam parameter '{name}'; {nearest(name, PARAMETERS)}")
    return PARAMETERS[name]


def placed(monopoles: Monopoles, values: Mapping[str, float | Float[Array, ""]]) -> Monopoles:
    """The antennas with these values of parameters."""
    for name, value in values.items():
        value = jnp.asarray(value, dtype=jnp.float64)
        monopoles = eqx.tree_at(parameter(name).where, monopoles, value)
    return monopoles
