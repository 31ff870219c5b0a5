"""The section of a log-normal prior: a positive sky."""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
from pydantic import Field, model_validator

from lusee_bayes.experiment.schema.section import Positive
from lusee_bayes.experiment.schema.template import TemplateSection
from lusee_bayes.sampling.log_normal.prior import LogNormalPrior
from lusee_bayes.sky import BRIGHT_SOURCES
from lusee_bayes.sky.log_normal import LogNormalSky, deviation_spectrum

# what is expected of A and of the tilt where they are learned: as of relative deviations
AMPLITUDE, TILT = 0.04, -2.5
LOG_AMPLITUDE_STD, TILT_STD = 1.0, 0.5


class LogNormalPriorSection(TemplateSection):
    """A template times the exponential of a Gaussian field: positive everywhere.

    C_ell of the field is A^2 ((ell + 1) / 10)^tilt. A and the tilt are learned from the data, or
    given.

    Attributes
    ----------
    template : str
        ``embedded``, the diffuse Galaxy without random structure, or a file: a map in K, Galactic,
        coefficients, or posterior.nc of another map. It has to be positive everywhere.
    file_frequency_mhz : float
        What the file was made for; by default what it says, or the scenario's frequency.
    spectral_index : float
        Scales the file from its frequency to the scenario's.
    smoothing_deg : float
        Full width at half maximum of a Gaussian beam that the file's sky is smoothed with.
    amplitude : float
        A, of the logarithm of the sky over its template; learned, with the tilt, if it is left out.
    tilt : float
        Slope of C_ell; needed with A.
    scale_std : float
        Standard deviation of the logarithm of the template's overall scale.
    sources : bool
        Add the catalogue's sources, each with a positive flux that may be small; a file may hold
        them already, the embedded template does not.
    """

    model: Literal["lognormal"] = "lognormal"
    tilt: Annotated[float, Field(ge=-20, le=20)] | None = None
    scale_std: Positive = 0.5
    sources: bool = True

    @model_validator(mode="after")
    def _both_or_neither(self) -> LogNormalPriorSection:
        if (self.amplitude is None) != (self.tilt is None):
            raise ValueError("give both amplitude and tilt, or neither, and they are learned")
        return self

    def family(self, frequency_mhz: float, lmax: int) -> LogNormalPrior:
        """The prior up to an ell; A and the tilt are unknowns of it where they are learned."""
        template = self.template_at(frequency_mhz, lmax)
        amplitude, tilt, widths = AMPLITUDE, TILT, (LOG_AMPLITUDE_STD, TILT_STD)
        if self.amplitude is not None and self.tilt is not None:
            amplitude, tilt, widths = self.amplitude, self.tilt, None
        level = np.array([4.0 * np.pi * self.scale_std**2])
        spectrum = deviation_spectrum(lmax, amplitude, tilt, level)
        sources = BRIGHT_SOURCES if self.sources else ()
        sky = LogNormalSky.of(template, spectrum, frequency_mhz, sources)
        return LogNormalPrior.of(sky, amplitude, tilt, widths)
