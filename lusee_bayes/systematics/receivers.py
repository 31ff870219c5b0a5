"""Noise of the receivers: every port's own power, constant in time, in that port's auto.

The mean power is part of the background, and so of the radiometer noise; the unknowns are each
port's deviations from it.
"""

from typing import Annotated

import jax
import numpy as np
from jaxtyping import Float, PRNGKeyArray
from pydantic import Field

from lusee_bayes.core.errors import InputError
from lusee_bayes.core.section import Megahertz, Positive, Section, Treatment, requires
from lusee_bayes.instrument.beams.source import BeamSource
from lusee_bayes.instrument.products import auto_indices
from lusee_bayes.systematics.context import Around, Setup
from lusee_bayes.systematics.systematic import Temperatures, Truth, Unknown

# number of cosines and sines in a smooth spectrum
N_WAVES = 512


class ReceiverNoiseSection(Section):
    """Constant receiver noise in the auto of every port; give one of the two powers.

    Attributes
    ----------
    power_v2_hz : float
        Mean power in V^2/Hz at the receiver input; needs a response file, calibrated in volts.
    power_k : float
        Mean power as an antenna temperature.
    slope : float
        Spectral exponent of the mean power.
    reference_mhz : float
        Frequency at which the mean equals the given power.
    relative_std : float
        Prior standard deviation of each port's power, relative to the mean.
    smooth_octaves : float
        Correlation length in octaves of each port's power error, a smooth function of frequency; if
        omitted, the errors at different frequencies are independent.
    treatment : {"marginalised", "sampled", "ignored"}
        Add their covariance to N, sample the powers with the map, or assume that all powers equal
        the mean.
    """

    power_v2_hz: Positive | None = None
    power_k: Positive | None = None
    slope: Annotated[float, Field(ge=-10, le=10)] = 0.0
    reference_mhz: Megahertz = 10.0
    relative_std: Positive = 0.1
    smooth_octaves: Positive | None = None
    treatment: Treatment = "marginalised"

    _one_power = requires(
        lambda section: (section.power_v2_hz is None) != (section.power_k is None),
        "give either power_v2_hz or power_k",
    )

    def powers(self, source: BeamSource, frequency_mhz: float) -> Float[np.ndarray, " ports"]:
        """Mean noise of every port's receiver in K.

        Raises
        ------
        InputError
            If it is given in V^2/Hz, and the beams are not calibrated in volts.
        """
        rise = (frequency_mhz / self.reference_mhz) ** self.slope
        if self.power_k is not None:
            return np.full(source.n_ports, self.power_k * rise)
        if (circuit := source.circuit(frequency_mhz)) is None:
            raise InputError(
                "noise.receiver.power_v2_hz needs antennas calibrated in volts, i.e. a response "
                "file; give it as beam.file, or use noise.receiver.power_k"
            )
        return self.power_v2_hz * rise / circuit.per_kelvin.diagonal().real


class Receivers(Temperatures):
    """Powers of the receivers, each in its port's auto."""

    key, section, words, draw = "noise.receiver", ReceiverNoiseSection, "the receivers", 8

    @classmethod
    def octaves(cls, section: ReceiverNoiseSection) -> float:
        return section.smooth_octaves or 0.0

    @classmethod
    def build(cls, section: ReceiverNoiseSection, setup: Setup, around: Around) -> "Receivers":
        powers = section.powers(setup.beam_source, setup.frequency_mhz)
        on_auto = np.asarray(setup.layout.product)[:, None] == auto_indices(len(powers))[None]
        sites = [f"receiver_{port}_k" for port in range(len(powers))]
        unknowns = tuple(map(Unknown, sites, powers, section.relative_std * powers))
        return cls(unknowns, on_auto.astype(np.float64))

    @classmethod
    def truth(cls, section: ReceiverNoiseSection, setup: Setup, key: PRNGKeyArray) -> Truth:
        if section.smooth_octaves is None:
            return super().truth(section, setup, key)
        x, n = np.log2(setup.frequency_mhz) / section.smooth_octaves, setup.beam_source.n_ports
        # sum_k (a_k cos w_k x + b_k sin w_k x) / sqrt(K), where a, b, w ~ N(0, 1): its covariance
        # over keys, the mean of cos w (x - x'), is exp(-(x - x')^2 / 2)
        waves, cosines, sines = np.asarray(jax.random.normal(cls.own_key(key), (3, n, N_WAVES)))
        z = (cosines * np.cos(waves * x) + sines * np.sin(waves * x)).sum(1) / np.sqrt(N_WAVES)
        return cls.build(section, setup, Around()).values(z)
