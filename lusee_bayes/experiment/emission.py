"""What a scenario's antennas and receivers add to every visibility, whatever the sky."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from lusee_bayes.core.arrays import Array
from lusee_bayes.core.errors import InputError
from lusee_bayes.experiment.scenario import Scenario
from lusee_bayes.instrument.beams import BeamSource
from lusee_bayes.instrument.products import auto_indices


def background_of(scenario: Scenario, source: BeamSource) -> Float[Array, " products"]:
    """Visibilities without any sky: ground, antennas, and receivers with their mean noise; in K.

    Parameters
    ----------
    scenario : Scenario
    source : BeamSource
        Its beams, behind the receivers of the data.

    Raises
    ------
    InputError
        If the scenario's receivers or ground need to know of the beams what these do not say.
    """
    background = np.array(source.background(scenario.frequency_mhz))
    if scenario.noise.regolith is not None:
        ground_per_kelvin(source, scenario.frequency_mhz)  # refuses what has no ground
    background[auto_indices(source.n_ports)] += receiver_powers(scenario, source)
    return background


def receiver_powers(scenario: Scenario, source: BeamSource) -> Float[np.ndarray, " ports"]:
    """Mean noise of every port's receiver in K; zeros where the scenario has none.

    Raises
    ------
    InputError
        If it is given in V^2/Hz, and the beams know no volts.
    """
    section, frequency = scenario.noise.receiver, scenario.frequency_mhz
    if section is None:
        return np.zeros(source.n_ports)
    rise = (frequency / section.reference_mhz) ** section.slope
    if section.power_k is not None:
        return np.full(source.n_ports, section.power_k * rise)
    circuit = source.circuit(frequency)
    if circuit is None:
        raise InputError(
            "noise.receiver.power_v2_hz needs antennas that know volts, which are those of a "
            "response file; give that as beam.file, or use noise.receiver.power_k"
        )
    return section.power_v2_hz * rise / circuit.per_kelvin.diagonal().real


def ground_per_kelvin(source: BeamSource, frequency_mhz: float) -> Float[Array, " products"]:
    """Visibilities that each kelvin of the ground's temperature adds, in K per K.

    Raises
    ------
    InputError
        If the beams do not say what the ground emits.
    """
    if not hasattr(source, "moon_k"):
        raise InputError(
            "noise.regolith needs antennas that receive from the ground, which are those of a "
            "response file or of a scalar beam file; give one as beam.file, or leave out "
            "noise.regolith"
        )
    warm, cold = (replace(source, moon_k=kelvin) for kelvin in (1.0, 0.0))
    return np.asarray(warm.background(frequency_mhz)) - np.asarray(cold.background(frequency_mhz))
