"""The parameters of the embedded antennas by name, with their domains."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import equinox as eqx
import numpy as np
from jaxtyping import Float

from lusee_bayes.core.arrays import Array, namespace
from lusee_bayes.core.errors import InputError, nearest
from lusee_bayes.instrument.beams.monopoles import Monopoles


@dataclass(frozen=True)
class Parameter:
    """A parameter of the embedded antennas.

    Attributes
    ----------
    where : callable
        Returns the parameter of given antennas.
    low, high : float
        Ends of its domain.
    """

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
    """Return the parameter of this name.

    Raises
    ------
    InputError
        If there is none; the message gives the nearest name.
    """
    if name not in PARAMETERS:
        raise InputError(f"unknown beam parameter '{name}'; {nearest(name, PARAMETERS)}")
    return PARAMETERS[name]


def placed(monopoles: Monopoles, values: Mapping[str, float | Float[Array, ""]]) -> Monopoles:
    """Return the antennas with other values of the named parameters.

    Raises
    ------
    InputError
        If a name is unknown.
    """
    for name, value in values.items():
        value = namespace(value).asarray(value, dtype=np.float64)
        monopoles = eqx.tree_at(parameter(name).where, monopoles, value)
    return monopoles
