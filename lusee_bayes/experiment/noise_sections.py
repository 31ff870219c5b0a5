"""Sections of a scenario on the terms of N, receivers, ground and gain table among them."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from lusee_bayes.experiment.instrument_sections import PointingSection
from lusee_bayes.experiment.section import (
    NOT_TINY,
    Megahertz,
    Positive,
    Section,
    Seed,
    Treatment,
    requires,
)


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

    _one_power = requires(
        lambda section: (section.power_v2_hz is None) != (section.power_k is None),
        "give either power_v2_hz or power_k",
    )


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

    std: Annotated[float, Field(gt=0, le=0.1), NOT_TINY] | None = None
    treatment: Treatment = "marginalised"


# visibilities that a term of N is built around: the modelled sky's, the data, or the map's own
NoiseAbout = Literal["model", "measured", "posterior"]


class RadiometerSection(Section):
    """Radiometer noise.

    Attributes
    ----------
    form : {"paper", "exact"}
        ``paper``: independent products; ``exact``: the covariance of the products at each time.
    bandwidth_hz : float
        Width of a channel.
    duty_cycle : float
        Share of the live time in which the spectrometer integrates: 1 where data or a schedule say
        their live time as it was.
    factor : float
        Factor of the noise variance.
    log_factor_std : float
        Prior standard deviation of ln of a further factor of the variance, where the level is not
        known. Simulated data hold one drawn from it, and it is sampled.
    temperature : {"model", "measured", "posterior"}, optional
        Visibilities that set the level: the modelled sky's, the data themselves, or the map's own
        prediction, in rounds. By default the modelled sky's for simulated data, and for measured
        ones the data themselves, unless their noise would bias the map; then the map's prediction.
    """

    form: Literal["paper", "exact"] = "paper"
    bandwidth_hz: Positive = 1.0e6
    duty_cycle: Annotated[float, Field(gt=0, le=1)] = 1.0
    factor: Positive = 1.0
    log_factor_std: Positive | None = None
    temperature: NoiseAbout | None = None


class GainSection(Section):
    """Gain drifts in the data: their covariance in N, or the drifts themselves ``sampled``.

    Attributes
    ----------
    sigma : float
        Standard deviation of the relative gains.
    correlation_h : float
        Correlation time.
    log_sigma_std : float
        Prior standard deviation of ln sigma, where it is not known. Simulated data hold one drawn
        from it, and it is sampled with the drifts.
    log_correlation_std : float
        The same for ln of the correlation time.
    treatment : {"marginalised", "sampled", "ignored"}
        Their covariance is added to N, they are sampled with the map, or they are left out of the
        model.
    visibilities : {"model", "measured", "posterior"}, optional
        Visibilities that the covariance is built around: the modelled sky's; the data, whose own
        drifts move the map by about a standard deviation; or the map's prediction, in rounds. By
        default the modelled sky's for simulated data, and the map's prediction for measured ones.
    """

    sigma: Positive = 0.01
    correlation_h: Positive = 10.0
    log_sigma_std: Positive | None = None
    log_correlation_std: Annotated[float, Field(gt=0, le=1)] | None = None
    treatment: Treatment = "marginalised"
    visibilities: NoiseAbout | None = None

    _scales_are_sampled = requires(
        lambda section: (
            section.treatment != "marginalised"
            or (section.log_sigma_std is None and section.log_correlation_std is None)
        ),
        "log_sigma_std and log_correlation_std need treatment 'sampled': a covariance has to know "
        "its scales",
    )


class BeamErrorSection(Section):
    """Beams that differ from the model's in the data; give one of the first three keys.

    Attributes
    ----------
    shift_mhz : float
        The data are taken with the beams of frequency + shift.
    file : str
        The data are taken with the beams of this file.
    parameters : dict
        Prior standard deviations of parameters of the embedded antennas about the values in
        ``beam``, by name; the data's own are drawn with the seed.
    treatment : {"marginalised", "sampled", "ignored"}
        The error's covariance is added to N, its amplitude or parameters are sampled with the
        map, or it is left out of the model.
    """

    shift_mhz: Annotated[float, Field(ge=-49, le=49)] | None = None
    file: str | None = None
    parameters: dict[str, Positive] = Field(default_factory=dict)
    treatment: Treatment = "marginalised"

    _one_direction = requires(
        lambda section: (
            [section.shift_mhz, section.file, section.parameters or None].count(None) == 2
        ),
        "give either shift_mhz, file or parameters",
    )


class NoiseSection(Section):
    """The terms of N; a term that is left out is neither in the data nor in N.

    Attributes
    ----------
    radiometer : RadiometerSection
        Radiometer noise.
    gain : GainSection
        Gain drifts.
    beam : BeamErrorSection
        Beam errors.
    pointing : PointingSection
        Offsets of clock and pointing.
    receiver : ReceiverNoiseSection
        Noise of the receivers.
    regolith : RegolithSection
        Temperature of the ground.
    gain_table : GainTableSection
        Errors of the gain table.
    """

    radiometer: RadiometerSection = RadiometerSection()
    gain: GainSection | None = None
    beam: BeamErrorSection | None = None
    pointing: PointingSection | None = None
    receiver: ReceiverNoiseSection | None = None
    regolith: RegolithSection | None = None
    gain_table: GainTableSection | None = None
