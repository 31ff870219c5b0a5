"""Temperature of the ground, whose emission is in every product."""

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from lusee_bayes.core.arrays import Array
from lusee_bayes.core.errors import InputError
from lusee_bayes.core.section import Positive, Section, Treatment
from lusee_bayes.instrument.beams.source import BeamSource
from lusee_bayes.systematics.context import Around, Setup
from lusee_bayes.systematics.systematic import Temperatures, Unknown


class RegolithSection(Section):
    """Temperature of the ground, with ``beam.moon_temperature_k`` as its prior mean.

    Attributes
    ----------
    std_k : float
        Prior standard deviation.
    treatment : {"marginalised", "sampled", "ignored"}
        Add its covariance to N, sample it with the map, or assume that
        ``beam.moon_temperature_k`` is exact.
    """

    std_k: Positive
    treatment: Treatment = "marginalised"


class RegolithTemperature(Temperatures):
    """Temperature of the ground."""

    key, section, words, draw = "noise.regolith", RegolithSection, "the regolith", 9

    @classmethod
    def build(cls, section: RegolithSection, setup: Setup, around: Around):
        added = ground_per_kelvin(setup.beam_source, setup.beams.frequency_mhz)
        seen = added[np.asarray(setup.layout.product)]
        mean = setup.scenario.beam.moon_temperature_k
        return cls((Unknown("regolith_k", mean, section.std_k),), seen[:, None])


def ground_per_kelvin(source: BeamSource, frequency_mhz: float) -> Float[Array, " products"]:
    """Visibilities that each kelvin of the ground's temperature adds, in K per K.

    Raises
    ------
    InputError
        If the beams do not specify the ground's emission.
    """
    if not hasattr(source, "moon_k"):
        raise InputError(
            "noise.regolith needs antennas that receive from the ground, i.e. a response file or a "
            "scalar beam file; give one as beam.file, or remove noise.regolith"
        )
    warm, cold = (replace(source, moon_k=kelvin) for kelvin in (1.0, 0.0))
    return np.asarray(warm.background(frequency_mhz)) - np.asarray(cold.background(frequency_mhz))
