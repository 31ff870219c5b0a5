"""The terms of N."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from lusee_bayes.experiment.schema.section import Positive, Section, Treatment


class RadiometerSection(Section):
    """Radiometer noise; ``temperature`` says whose visibilities set its level.

    ``log_factor_std``: prior standard deviation of ln of a further factor of the variance, where
    the level is not known; simulated data hold one drawn from it, and it is sampled.
    """

    form: Literal["paper", "exact"] = "paper"
    bandwidth_hz: Positive = 1.0e6
    duty_cycle: Annotated[float, Field(gt=0, le=1)] = 1.0
    factor: Positive = 1.0
    log_factor_std: Positive | None = None
    temperature: Literal["model", "measured"] = "model"


class GainSection(Section):
    """Gain drifts in the data: their covariance in N, or the drifts themselves ``sampled``.

    ``log_sigma_std`` and ``log_correlation_std``: prior standard deviations of ln of the two where
    they are not known; simulated data hold drawn ones, and they are sampled with the drifts.

    ``visibilities``: the d that the covariance is built around. ``measured`` data hold the drifts
    themselves, which moves the map by about a standard deviation; ``posterior`` starts from them
    and repeats with the map's prediction until the map stops moving, which mends that.
    """

    sigma: Positive = 0.01
    correlation_h: Positive = 10.0
    log_sigma_std: Positive | None = None
    log_correlation_std: Annotated[float, Field(gt=0, le=1)] | None = None
    treatment: Treatment = "marginalised"
    visibilities: Literal["model", "measured", "posterior"] = "model"

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
    """Beams that differ from the model's in the data; marginalised in N, sampled or ignored.

    ``shift_mhz``: the data are taken with the beams of frequency + shift, ``file``: with those of
    another file; sampled is the amplitude of that error. ``parameters``: prior standard deviations
    of parameters of the embedded antennas about the values in ``beam``; the data's own are drawn
    with the seed.
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
    """The terms of N; a term that is left out is neither in the data nor in N."""

    radiometer: RadiometerSection = RadiometerSection()
    gain: GainSection | None = None
    beam: BeamErrorSection | None = None
