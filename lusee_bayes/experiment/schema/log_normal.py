"""The prior of the program ``log_normal``: a positive sky."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from pydantic import Field, model_validator

from lusee_bayes.experiment.schema.section import Positive, Section
from lusee_bayes.sampling.log_normal_prior import LogNormalPrior
from lusee_bayes.sky import BRIGHT_SOURCES
from lusee_bayes.sky.log_normal import LogNormalSky, deviation_spectrum
from lusee_bayes.sky.template import EmbeddedTemplate

# what is expected of A and of the tilt where they are sampled: as of relative deviations
AMPLITUDE, TILT = 0.04, -2.5
LOG_AMPLITUDE_STD, TILT_STD = 1.0, 0.5


class LogNormalSection(Section):
    """The positive sky of the program ``log_normal``, which has a prior of its own.

    It is the embedded diffuse Galaxy times the exponential of a Gaussian field, whose C_ell is
    A^2 ((ell + 1) / 10)^tilt. A and the tilt are sampled with the sky, or given.

    Attributes
    ----------
    amplitude : float
        A, of the logarithm of the sky over the Galaxy; sampled, with the tilt, if it is left out.
    tilt : float
        Slope of C_ell; needed with A.
    scale_std : float
        Standard deviation of the logarithm of the Galaxy's overall scale.
    sources : bool
        Add the catalogue's sources, each with a positive flux that may be small.
    """

    amplitude: Positive | None = None
    tilt: Annotated[float, Field(ge=-20, le=20)] | None = None
    scale_std: Positive = 0.5
    sources: bool = True

    @model_validator(mode="after")
    def _both_or_neither(self) -> LogNormalSection:
        if (self.amplitude is None) != (self.tilt is None):
            raise ValueError("give both amplitude and tilt, or neither, and they are sampled")
        return self

    def prior(self, frequency_mhz: float, lmax: int) -> LogNormalPrior:
        """The prior up to an ell."""
        amplitude, tilt, widths = AMPLITUDE, TILT, (LOG_AMPLITUDE_STD, TILT_STD)
        if self.amplitude is not None and self.tilt is not None:
            amplitude, tilt, widths = self.amplitude, self.tilt, None
        level = np.array([4.0 * np.pi * self.scale_std**2])
        spectrum = deviation_spectrum(lmax, amplitude, tilt, level)
        sources = BRIGHT_SOURCES if self.sources else ()
        template = EmbeddedTemplate(frequency_mhz)
        sky = LogNormalSky.of(template, spectrum, frequency_mhz, sources)
        return LogNormalPrior.of(sky, amplitude, tilt, widths)
