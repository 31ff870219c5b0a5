"""The prior on skies of several frequencies."""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from lusee_bayes.experiment.schema.section import Positive, Section
from lusee_bayes.sky.spectral_prior import SpectralPrior


class SpectralSection(Section):
    """The prior on skies of several frequencies that are mapped together.

    C_ell of the components follow from the scenario's skies.

    Attributes
    ----------
    model : {"components", "kernel"}
        A sum of maps with given spectra, or a power law times a Gaussian process in ln nu.
    components : tuple of str
        Spectra of the maps: a power law, its curvature (times ln nu) and its turnover (times
        1 - exp(-tau), tau = (turnover_mhz / nu)^2.1).
    index : float
        Spectral index of the power law.
    reference_mhz : float
        Frequency at which the components are given.
    turnover_mhz : float
        Frequency of optical depth 1 in the turnover.
    length : float
        Correlation length of the Gaussian process in ln nu.
    residual : float
        rms of what each channel has of its own, over that of its sky; by default what the
        components leave of the skies, 0.01 with the kernel.
    solver : {"auto", "direct", "conjugate_gradients"}
        ``auto``: conjugate gradients where the direct solution does not fit.
    tolerance : float
        Relative residual at which conjugate gradients stop.
    iterations : int
        Most iterations of conjugate gradients.
    """

    model: Literal["components", "kernel"] = "components"
    components: Annotated[
        tuple[Literal["power_law", "curvature", "turnover"], ...], Field(min_length=1)
    ] = ("power_law", "curvature", "turnover")
    index: Annotated[float, Field(ge=-20, le=20)] = -2.5
    reference_mhz: Positive = 20.0
    turnover_mhz: Positive = 5.0
    length: Positive = 1.0
    residual: Annotated[float, Field(ge=0, le=1)] | None = None
    solver: Literal["auto", "direct", "conjugate_gradients"] = "auto"
    tolerance: Positive = 1e-7
    iterations: Annotated[int, Field(ge=1)] = 500

    def prior(self, frequencies_mhz: np.ndarray, skies: np.ndarray) -> SpectralPrior:
        """The prior on the skies of all channels; ``skies`` (channels, modes) model them."""
        common = {"index": self.index, "reference_mhz": self.reference_mhz}
        if self.model == "components":
            return SpectralPrior.components(
                frequencies_mhz,
                skies,
                self.components,
                turnover_mhz=self.turnover_mhz,
                residual=self.residual,
                **common,
            )
        residual = {} if self.residual is None else {"residual": self.residual}
        return SpectralPrior.kernel(
            frequencies_mhz, skies, length=self.length, **common, **residual
        )
