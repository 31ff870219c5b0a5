"""What is not known about receivers, ground and gain table."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field, model_validator

from lusee_bayes.experiment.schema.section import Megahertz, Positive, Section, Seed, Treatment


class ReceiverNoiseSection(Section):
    """Noise of every port's receiver: constant, in that port's auto; give one of the powers.

    Attributes
    ----------
    power_v2_hz : float
        Mean power in V^2/Hz at the receiver's input; needs a response file, which knows volts.
    power_k : float
        Mean power as an antenna temperature.
    slope : float
        Exponent of frequency, with which the mean goes.
    reference_mhz : float
        Frequency at which the mean is the given power.
    relative_std : float
        Prior standard deviation of every port's own power over the mean.
    smooth_octaves : float
        What a port's power is off by is a smooth function of frequency, which forgets itself over
        so many octaves; without it, every frequency has an error of its own.
    smooth_seed : int
        Seed of that function in simulated data; by default the scenario's. Channels of a run of
        several frequencies have that of the run.
    treatment : {"marginalised", "sampled", "ignored"}
        Their covariance is added to N, the powers are sampled with the map, or the model takes
        all of them for the mean.
    """

    power_v2_hz: Positive | None = None
    power_k: Positive | None = None
    slope: Annotated[float, Field(ge=-10, le=10)] = 0.0
    reference_mhz: Megahertz = 10.0
    relative_std: Positive = 0.1
    smooth_octaves: Positive | None = None
    smooth_seed: Seed | None = None
    treatment: Treatment = "marginalised"

    @model_validator(mode="after")
    def _one_power(self) -> ReceiverNoiseSection:
        if (self.power_v2_hz is None) == (self.power_k is None):
            raise ValueError("give either power_v2_hz or power_k")
        return self


class RegolithSection(Section):
    """Temperature of the ground, known to be about ``beam.moon_temperature_k``.

    Attributes
    ----------
    std_k : float
        Prior standard deviation.
    treatment : {"marginalised", "sampled", "ignored"}
        Its covariance is added to N, it is sampled with the map, or the model takes
        ``beam.moon_temperature_k`` for the truth.
    """

    std_k: Positive
    treatment: Treatment = "marginalised"


class GainTableSection(Section):
    """Errors of the gain table, which all spectra of one level of one port share.

    Attributes
    ----------
    std : float
        Prior standard deviation of every port's power gain, relative, where the data do not say
        the errors of their table themselves and ``flight.gain_std`` does not, either.
    treatment : {"marginalised", "sampled", "ignored"}
        Their covariance is added to N to first order about what the data tell, found in rounds;
        they are sampled with the map; or they are left out of the model.
    """

    std: Annotated[Positive, Field(le=0.1)] | None = None
    treatment: Treatment = "marginalised"
