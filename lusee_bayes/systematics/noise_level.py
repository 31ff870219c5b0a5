"""The level of the radiometer noise, and which visibilities it is built around.

There is no Gaussian term for a factor of a variance: marginalised, the level stays at one.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated, Any, ClassVar, Literal

import equinox as eqx
import numpy as np
from jaxtyping import Float
from pydantic import Field

from lusee_bayes.core.arrays import Array, scalar
from lusee_bayes.core.section import Positive, Section
from lusee_bayes.systematics.context import Around, NoiseAbout, Setup
from lusee_bayes.systematics.systematic import Scale, Unknown

# in standard deviations of a common amplitude
HARMLESS_BIAS = 0.1


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


class NoiseLevel(Scale):
    """A factor of the variance of all noise that the model holds so far.

    Attributes
    ----------
    log_std : () array
        Prior standard deviation of the natural logarithm of the factor, whose median is one.
    """

    key: ClassVar[str] = "noise.radiometer"
    section: ClassVar[type[Section]] = RadiometerSection
    draw: ClassVar[int] = 4

    log_std: Float[Array, ""] = eqx.field(converter=scalar)

    @classmethod
    def treatment(cls, scenario: Any) -> str | None:
        return None if scenario.noise.radiometer.log_factor_std is None else "sampled"

    @classmethod
    def build(cls, section: RadiometerSection, setup: Setup, around: Around) -> NoiseLevel:
        return cls(section.log_factor_std)

    @property
    def unknowns(self) -> tuple[Unknown, ...]:
        return (Unknown("noise_level", 1.0, self.log_std, log=True),)

    def effect(self, model, values):
        """Scale N by the ratio of variances."""
        return replace(model, noise=model.noise.scaled(values["noise_level"]))


def radiometer_about(setup: Setup) -> NoiseAbout:
    """Which visibilities set the level of the radiometer noise."""
    chosen = setup.scenario.noise.radiometer.temperature
    if chosen is not None or not setup.measured:
        return chosen or "model"
    harmless = setup.has_autos and common_bias(setup) < HARMLESS_BIAS
    return "measured" if harmless else "posterior"


def common_bias(setup: Setup) -> float:
    """How far noise in measured visibilities moves a common amplitude, in standard deviations."""
    section, observation = setup.scenario.noise.radiometer, setup.observation
    if setup.calibration is not None:
        samples = np.asarray(setup.calibration.n_averaged)
    else:
        samples = section.bandwidth_hz * section.duty_cycle * np.asarray(observation.live_s)
    n_antennas = setup.beam_source.n_ports
    ratio = section.factor * observation.n_times / float(np.median(samples))
    return float(4.0 * n_antennas * np.sqrt(ratio))
