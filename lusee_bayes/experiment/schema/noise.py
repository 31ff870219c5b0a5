"""The terms of N."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from lusee_bayes.experiment.schema.pointing import PointingSection
from lusee_bayes.experiment.schema.section import Positive, Section, Treatment
from lusee_bayes.experiment.schema.unknowns import (
    GainTableSection,
    ReceiverNoiseSection,
    RegolithSection,
)

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

    @model_validator(mode="after")
    def _scales_are_sampled(self) -> GainSection:
        known = self.log_sigma_std is None and self.log_correlation_std is None
        if not known and self.treatment == "marginalised":
            raise ValueError(
                "log_sigma_std and log_correlation_std need treatment 'sampled': a covariance "
                "has to know its scales"
            )
        return self


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

    @model_validator(mode="after")
    def _one_direction(self) -> BeamErrorSection:
        if (self.shift_mhz is not None) + (self.file is not None) + bool(self.parameters) != 1:
            raise ValueError("give either shift_mhz, file or parameters")
        return self


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
