"""The prior on the sky."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from lusee_bayes.experiment.schema.section import Positive, Section
from lusee_bayes.sky import Sky
from lusee_bayes.sky.prior_files import read_mean, read_spectrum
from lusee_bayes.sky.priors import HarmonicPrior, Prior


class IsotropicPriorSection(Section):
    """Independent coefficients: C_ell the spectrum of the scenario's sky, or of a file; mean 0.

    Where C_ell is not known, an amplitude and a tilt are sampled, C_ell A ((ell + 1) / 10)^tilt, or
    one amplitude for every band of ell.

    Attributes
    ----------
    scale : float
        Multiplies C_ell.
    spectrum_file : str
        Text with lines of ell and C_ell in K^2, in place of the scenario's sky.
    mean_file : str
        The prior mean: a HEALPix FITS map in K, Galactic.
    file_frequency_mhz : float
        What these files were made for; by default the scenario's frequency.
    spectral_index : float
        Scales them from ``file_frequency_mhz`` to the scenario's frequency: the mean once, C_ell
        twice.
    log_amplitude_std : float
        Prior standard deviation of ln A; A is sampled if it is given.
    tilt_std : float
        Prior standard deviation of the tilt, which is sampled if it is given.
    band_edges : tuple of int
        First ell of each band but the lowest; amplitudes of the bands are sampled if it is given.
    log_band_std : float
        Prior standard deviation of ln of each band's amplitude.
    """

    model: Literal["isotropic"] = "isotropic"
    scale: Positive = 1.0
    spectrum_file: str | None = None
    mean_file: str | None = None
    file_frequency_mhz: Positive | None = None
    spectral_index: Annotated[float, Field(ge=-20, le=20)] = -2.5
    log_amplitude_std: Positive | None = None
    tilt_std: Positive | None = None
    band_edges: tuple[Annotated[int, Field(ge=1)], ...] = ()
    log_band_std: Positive = 1.0

    @model_validator(mode="before")
    @classmethod
    def _spectrum_had_one_value(cls, value: Any) -> Any:
        """``spectrum: sky`` was an entry once, with this one value."""
        if isinstance(value, dict) and value.get("spectrum") == "sky":
            return {name: v for name, v in value.items() if name != "spectrum"}
        return value

    @model_validator(mode="after")
    def _one_parameterisation(self) -> IsotropicPriorSection:
        if self.band_edges and (self.log_amplitude_std or self.tilt_std):
            raise ValueError("give either band_edges or log_amplitude_std and tilt_std")
        if list(self.band_edges) != sorted(set(self.band_edges)):
            raise ValueError("band_edges must grow from one to the next")
        return self

    def prior(self, sky: Sky) -> Prior:
        """S, and the mean, at the frequency and up to the lmax of a model sky."""
        read_at = self.file_frequency_mhz or sky.frequency_mhz
        steepening = (sky.frequency_mhz / read_at) ** self.spectral_index
        spectrum = sky.spectrum()
        if self.spectrum_file is not None:
            spectrum = read_spectrum(self.spectrum_file, sky.lmax) * steepening**2
        mean = None
        if self.mean_file is not None:
            mean = read_mean(self.mean_file, read_at, sky.lmax) * steepening
        return HarmonicPrior(spectrum * self.scale, mean=mean)

    @property
    def has_files(self) -> bool:
        """Whether the prior is read from files, which are of one frequency."""
        return self.spectrum_file is not None or self.mean_file is not None


# a further prior joins here, selected by ``model``
PriorSection = IsotropicPriorSection
