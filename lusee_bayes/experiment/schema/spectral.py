"""The prior on skies of several frequencies."""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from lusee_bayes.experiment.schema.section import Megahertz, Positive, Section
from lusee_bayes.sky.positive_skies import check_fields
from lusee_bayes.sky.spectral_prior import SpectralPrior, check_components


class SpectralSection(Section):
    """The prior on skies of several frequencies that are mapped together.

    C_ell of components and kernel follow from the scenario's skies; that of positive skies is
    learned from the data.

    Attributes
    ----------
    model : {"components", "kernel", "positive"}
        A sum of maps with given spectra, a power law times a Gaussian process in ln nu, or the
        embedded diffuse Galaxy times the exponential of fields, which is positive everywhere.
    components : tuple of str
        Spectra of the maps: a power law, its curvature (times ln nu) and its turnover (times
        1 - exp(-tau), tau = (turnover_mhz / nu)^2.1).
    fields : tuple of str
        What varies over positive skies: their level, spectral index and curvature (times ln nu and
        ln^2 nu), and the optical depth at turnover_mhz, which goes as nu^-2.1.
    sources : bool
        Give the catalogue's sources fluxes of their own in every channel of positive skies, each as
        uncertain as it is large.
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
    """

    model: Literal["components", "kernel", "positive"] = "components"
    components: Annotated[
        tuple[Literal["power_law", "curvature", "turnover"], ...], Field(min_length=1)
    ] = ("power_law", "curvature", "turnover")
    fields: Annotated[
        tuple[Literal["level", "index", "curvature", "absorption"], ...], Field(min_length=1)
    ] = ("level", "index", "curvature", "absorption")
    sources: bool = True
    index: Annotated[float, Field(ge=-20, le=20)] = -2.5
    reference_mhz: Megahertz = 20.0
    turnover_mhz: Megahertz = 5.0
    length: Positive = 1.0
    residual: Annotated[float, Field(ge=0, le=1)] | None = None

    def require_channels(self, n: int) -> None:
        """InputError for so few channels that they cannot share a posterior."""
        if self.model == "components":
            check_components(self.components, n, self.residual)
        if self.model == "positive":
            check_fields(self.fields, n)

    def n_maps(self, frequencies_mhz: tuple[float, ...]) -> int:
        """How many maps the skies of these channels are made of."""
        if self.model == "positive":
            return len(self.fields)
        if self.model == "components":
            return len(self.components)
        # as many principal spectra as matter
        frequencies = np.array(frequencies_mhz)
        return self.prior(frequencies, np.ones((len(frequencies), 1))).n_components

    def prior(self, frequencies_mhz: np.ndarray, skies: np.ndarray) -> SpectralPrior:
        """The prior on linear skies of all channels; ``skies`` (channels, modes) model them."""
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
