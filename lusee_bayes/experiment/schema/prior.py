"""The prior on the sky: one section for each kind, selected by ``model``.

A new kind is a class here, which makes its :class:`Prior`, and its name in ``PRIOR_SECTIONS``.
"""

from __future__ import annotations

from functools import reduce
from operator import or_
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BeforeValidator, Field, model_validator

from lusee_bayes.experiment.schema.section import Megahertz, Positive, Section, without_other_kinds
from lusee_bayes.sampling.log_normal_prior import LogNormalPrior
from lusee_bayes.sky import BRIGHT_SOURCES, Sky
from lusee_bayes.sky.local_scales import embedded_local_scales
from lusee_bayes.sky.log_normal import LogNormalSky, deviation_spectrum
from lusee_bayes.sky.prior_family import IsotropicFamily, PriorFamily
from lusee_bayes.sky.prior_files import read_mean, read_spectrum
from lusee_bayes.sky.priors import HarmonicPrior, Prior
from lusee_bayes.sky.template import EmbeddedTemplate

# where C_ell comes from
LEARNED = "learned from these data"
# what is expected of A and of the tilt where they are sampled: as of relative deviations
AMPLITUDE, TILT = 0.04, -2.5
LOG_AMPLITUDE_STD, TILT_STD = 1.0, 0.5


class IsotropicPriorSection(Section):
    """Independent coefficients: C_ell learned from the data, the sky's own, or a file's; mean 0.

    ``sky`` takes C_ell of the scenario's sky, which simulations know and observers do not: the
    paper's setting. With it or with a file's, an amplitude and a tilt can be sampled,
    C_ell A ((ell + 1) / 10)^tilt, or one amplitude for every band of ell.

    Attributes
    ----------
    spectrum : {"learned", "sky"}
        Where C_ell comes from, if not from a file: by default learned, unless another entry acts on
        a C_ell that is known.
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
    spectrum: Literal["learned", "sky"] = "learned"
    scale: Positive = 1.0
    spectrum_file: str | None = None
    mean_file: str | None = None
    file_frequency_mhz: Megahertz | None = None
    spectral_index: Annotated[float, Field(ge=-20, le=20)] = -2.5
    log_amplitude_std: Positive | None = None
    tilt_std: Positive | None = None
    band_edges: tuple[Annotated[int, Field(ge=1)], ...] = ()
    log_band_std: Positive = 1.0

    @model_validator(mode="before")
    @classmethod
    def _known_where_something_acts_on_it(cls, value: Any) -> Any:
        if not isinstance(value, dict) or value.get("spectrum") is not None:
            return value
        acting = ("scale", "mean_file", "log_amplitude_std", "tilt_std", "band_edges")
        known = any(value.get(name) for name in acting)
        return {**value, "spectrum": "sky" if known else "learned"}

    @model_validator(mode="after")
    def _one_parameterisation(self) -> IsotropicPriorSection:
        if self.band_edges and (self.log_amplitude_std or self.tilt_std):
            raise ValueError("give either band_edges or log_amplitude_std and tilt_std")
        if self.is_learned and (self.samples or self.scale != 1.0 or self.mean_file is not None):
            raise ValueError(
                "a learned C_ell has no scale, no mean_file and nothing to sample; give "
                "spectrum=sky or a spectrum_file with them"
            )
        if list(self.band_edges) != sorted(set(self.band_edges)):
            raise ValueError("band_edges must grow from one to the next")
        return self

    @property
    def is_learned(self) -> bool:
        """Whether the data tell C_ell."""
        return self.spectrum == "learned" and self.spectrum_file is None

    def family(self, frequency_mhz: float, lmax: int) -> PriorFamily | None:
        """The family that data choose a prior of, up to an ell; None if C_ell is given."""
        if not self.is_learned:
            return None
        return IsotropicFamily.around(_mean_temperature(frequency_mhz), lmax)

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
    def origin(self) -> str:
        """Where C_ell comes from."""
        if self.spectrum_file is not None:
            return f"of {self.spectrum_file}"
        return LEARNED if self.is_learned else "of the scenario's own sky"

    @property
    def has_files(self) -> bool:
        """Whether the prior is read from files, which are of one frequency."""
        return self.spectrum_file is not None or self.mean_file is not None

    @property
    def samples(self) -> bool:
        """Whether something of the prior is to be sampled."""
        known = self.log_amplitude_std is None and self.tilt_std is None
        return not known or bool(self.band_edges)


class LocalScalesPriorSection(Section):
    """A template, and Gaussian deviations whose strength at every place and scale is learned.

    The template is the embedded diffuse Galaxy; how much of it there is, whether the catalogue's
    sources are there, C_ell of the deviations, and how their strength goes with the template's
    brightness, with the Galactic plane and from place to place are all told by the data.

    Attributes
    ----------
    sources : bool
        Allow for the catalogue's sources.
    """

    model: Literal["local_scales"] = "local_scales"
    sources: bool = True

    @property
    def origin(self) -> str:
        """Where C_ell comes from."""
        return LEARNED

    @property
    def has_files(self) -> bool:
        """Whether the prior is read from files, which are of one frequency."""
        return False

    @property
    def samples(self) -> bool:
        """Whether something of the prior is to be sampled."""
        return False

    @property
    def is_learned(self) -> bool:
        """Whether the data tell C_ell."""
        return True

    def family(self, frequency_mhz: float, lmax: int) -> PriorFamily:
        """The family that data choose a prior of, up to an ell."""
        return embedded_local_scales(frequency_mhz, lmax, BRIGHT_SOURCES if self.sources else ())


PRIOR_SECTIONS = {
    section.model_fields["model"].default: section
    for section in (
        LocalScalesPriorSection,
        IsotropicPriorSection,
    )
}


def _one_kind(value: Any) -> Any:
    """``prior`` without a model is that of its entries: isotropic, as scenarios had it before."""
    if not isinstance(value, dict):
        return value
    tree = dict(value)
    if not tree.get("model"):
        told = set(tree) & set(IsotropicPriorSection.model_fields) - {"model"}
        default = IsotropicPriorSection if told else LocalScalesPriorSection
        tree["model"] = default.model_fields["model"].default
    if tree["model"] != "isotropic":  # another kind in the place of the paper's prior
        tree.pop("spectrum", None)
    return without_other_kinds(tree, PRIOR_SECTIONS, strict=True)


def _mean_temperature(frequency_mhz: float) -> float:
    """Of the embedded sky, in K."""
    return float(EmbeddedTemplate(frequency_mhz).modes(0)[0] / np.sqrt(4.0 * np.pi))


PriorSection = Annotated[
    reduce(or_, PRIOR_SECTIONS.values()), Field(discriminator="model"), BeforeValidator(_one_kind)
]


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
