"""The level of the radiometer noise, and the visibilities around which it is built.

There is no Gaussian term for a factor of a variance: if marginalised, the level stays at one.
"""

from dataclasses import replace
from typing import Annotated, Any, Literal

import equinox as eqx
import numpy as np
from pydantic import Field

from lusee_bayes.core.section import Positive, Section
from lusee_bayes.systematics.context import Around, NoiseAbout, Setup
from lusee_bayes.systematics.systematic import Scale, Unknown

# acceptable bias, in standard deviations of a common amplitude
HARMLESS_BIAS = 0.1


class RadiometerSection(Section):
    """Radiometer noise.

    Attributes
    ----------
    form : {"paper", "exact"}
        ``paper``: independent products; ``exact``: full covariance of the products at each time at
        which voltages can have the visibilities, otherwise independent products.
    bandwidth_hz : float
        Channel width.
    duty_cycle : float
        Fraction of the live time spent integrating. Use 1 if data or a schedule already give the
        true live time.
    factor : float
        Factor applied to the noise variance.
    log_factor_std : float
        Prior standard deviation of ln of an additional variance factor, for an unknown noise level.
        The factor is sampled; simulated data include one drawn from this prior.
    temperature : {"model", "measured", "posterior"}, optional
        Visibilities that set the noise level: those of the model sky, the data themselves, or the
        map's prediction (iterative). Default: the model sky for simulated data; for measured data
        the data themselves or, if their noise would bias the map, the map's prediction.
    """

    form: Literal["paper", "exact"] = "exact"
    bandwidth_hz: Positive = 1.0e6
    duty_cycle: Annotated[float, Field(gt=0, le=1)] = 1.0
    factor: Positive = 1.0
    log_factor_std: Positive | None = None
    temperature: NoiseAbout | None = None


class NoiseLevel(Scale):
    """A factor of the variance of all noise that the model contains so far.

    Attributes
    ----------
    unknowns : tuple of Unknown
        The factor, whose median is one.
    """

    key, section, draw = "noise.radiometer", RadiometerSection, 4

    unknowns: tuple[Unknown, ...] = eqx.field()

    @classmethod
    def treatment(cls, scenario: Any) -> str | None:
        return None if scenario.noise.radiometer.log_factor_std is None else "sampled"

    @classmethod
    def build(cls, section: RadiometerSection, setup: Setup, around: Around) -> "NoiseLevel":
        return cls((Unknown("noise_level", 1.0, section.log_factor_std, log=True),))

    def effect(self, model, values):
        """Scale N by the ratio of variances."""
        return replace(model, noise=model.noise.scaled(values["noise_level"]))


def radiometer_about(setup: Setup) -> NoiseAbout:
    """Visibilities that set the level of the radiometer noise."""
    section = setup.scenario.noise.radiometer
    if section.temperature is not None or not setup.measured:
        return section.temperature or "model"
    # how far noise in measured visibilities moves a common amplitude, in standard deviations
    ratio = section.factor * setup.observation.n_times / np.median(setup.n_averaged)
    harmless = 4.0 * setup.beam_source.n_ports * np.sqrt(ratio) < HARMLESS_BIAS
    return "measured" if setup.noise_is_seen and harmless else "posterior"
