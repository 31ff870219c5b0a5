"""Sections of a scenario on skies and priors.

Sky and prior have one section per kind, selected by ``model``. To add a kind, write a class here
that is a :class:`SkySource` or has a :class:`Prior`, and add it to ``SKY_SECTIONS`` or
``PRIOR_SECTIONS``. The prior on skies at several frequencies has a separate section.
"""

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, get_args

import numpy as np
from pydantic import Field, model_validator

from lusee_bayes.core import checks, harmonics, lazy
from lusee_bayes.core.errors import InputError
from lusee_bayes.core.reading import require_file
from lusee_bayes.core.section import Megahertz, Positive, Section, Seed, kinds_of, one_of, requires
from lusee_bayes.priors import families, local_scales
from lusee_bayes.priors.surveys import Survey
from lusee_bayes.sky import galaxy, sky_source
from lusee_bayes.sky.positive_skies import PositiveSkies
from lusee_bayes.sky.prior import HarmonicPrior, Prior, read_spectrum
from lusee_bayes.sky.spectral_prior import SpectralPrior, check_components
from lusee_bayes.systematics.prior_spectrum import SpectrumSection

# parts of skies at several frequencies: keys of SPECTRA and FIELDS
Component = Literal["power_law", "curvature", "turnover"]
SkyField = Literal["level", "index", "curvature", "absorption"]


class GalaxySection(Section, sky_source.SkySource):
    """The embedded model of the Galaxy.

    Attributes
    ----------
    seed : int
        Seed for the random small scales, loops, clouds and faint sources.
    sources : bool
        Include the brightest point sources.
    """

    model: Literal["galaxy"] = "galaxy"
    seed: Seed = 1
    sources: bool = True

    def at(self, frequency_mhz: float, lmax: int) -> sky_source.Sky:
        sources = galaxy.BRIGHT_SOURCES if self.sources else ()
        return sky_source.galaxy_sky(frequency_mhz, lmax, seed=self.seed, sources=sources)


class FileSkySection(Section, sky_source.SkySource):
    """A sky from a file: ULSA HDF5, HEALPix FITS, luseepy multi-map FITS, or coefficients.

    Attributes
    ----------
    file : str
        Path of the file.
    dataset : str
        Dataset to read from an HDF5 file.
    file_frequency_mhz : float
        Frequency of the sky in the file (default: the scenario's); it selects the map to read from
        a file with several frequencies.
    spectral_index : float
        Index for scaling the sky from ``file_frequency_mhz`` to the scenario's frequency.
    """

    # the catalogue's sources are not added: the file may contain them
    sources: ClassVar[bool] = False
    model: Literal["file"] = "file"
    file: str
    dataset: str | None = None
    file_frequency_mhz: Megahertz | None = None
    spectral_index: Annotated[float, Field(ge=-20, le=20)] = -2.5

    def at(self, frequency_mhz: float, lmax: int) -> sky_source.Sky:
        given = self.model_dump(exclude={"model", "file"})
        return sky_source.sky_from_file(self.file, frequency_mhz, lmax, **given)


# a survey fades out over its beam, or this width in degrees, beside pixels without data; it is
# compared with the map where its weight is larger than SEEN
EDGE_DEG, SEEN = 5.0, 0.99


class SurveySection(Section):
    """A survey of the sky, s = a (beam * sky) + b + errors, with unknown a and b.

    The survey is scaled to the scenario's frequency. Its errors, which include those of the index,
    are learned by position and scale.

    Attributes
    ----------
    file : str
        Path of a sky file in K, as for ``sky.file``; pixels without data are UNSEEN.
    dataset : str
        Dataset to read from an HDF5 file.
    frequency_mhz : float
        Frequency of the survey.
    index : float
        Index for scaling it to the scenario's frequency.
    beam_deg : float
        Full width of its beam at half maximum, in degrees.
    scale_std : float
        Prior standard deviation of its scale a, about 1.
    zero_std_k : float
        Prior standard deviation of its zero level b, in K at its own frequency.
    mask_file : str
        HEALPix FITS map of the same NSIDE: 0 or UNSEEN where the survey is not to be used.
    """

    file: str
    dataset: str | None = None
    frequency_mhz: Megahertz
    index: Annotated[float, Field(ge=-20, le=20)] = -2.5
    beam_deg: Annotated[float, Field(ge=0, le=60)] = 0.0
    scale_std: Positive = 0.1
    zero_std_k: Positive = 1000.0
    mask_file: str | None = None

    def at(self, frequency_mhz: float, lmax: int) -> Survey:
        """The survey at a frequency, up to lmax.

        Raises
        ------
        InputError
            If a file cannot be used, or the mask does not belong to the survey.
        """
        file = require_file(self.file, "survey", "check prior.surveys")
        sky, unseen = sky_source.read_sky_file(file, self.dataset), None
        beam = harmonics.per_mode(lazy.healpy.gauss_beam(np.radians(self.beam_deg), lmax))
        if isinstance(sky, sky_source.SkyMap):
            gaps = sky.unseen
            if self.mask_file is not None:
                path = require_file(self.mask_file, "mask", "check prior.surveys")
                mask = sky_source.SkyMap.read(path)
                checks.require_shape(f"{self.mask_file}: the mask", mask.pixels, gaps.shape)
                gaps = gaps | mask.unseen | (mask.pixels == 0.0)
            if gaps.all() or not sky.pixels[~gaps].mean() > 0.0:
                why = f"{self.file}: the pixels' mean must be positive, and not all of them masked"
                raise InputError(why)
            if gaps.any():
                template = sky_source.galaxy_sky(frequency_mhz, lmax, seed=None, sources=()).modes
                filled = harmonics.modes_to_map(beam * template, lazy.healpy.npix2nside(gaps.size))
                filled *= sky.pixels[~gaps].mean() / filled[~gaps].mean()
                # a sharp edge would be amplified where the beam is taken off
                width = np.radians(max(self.beam_deg, EDGE_DEG))
                near = lazy.healpy.smoothing(gaps.astype(float), width)
                weight = np.where(gaps, 0.0, np.clip(1.0 - 2.0 * near, 0.0, 1.0) ** 2)
                pixels = filled + weight * (sky.pixels - filled)
                sky, unseen = replace(sky, pixels=pixels), weight < SEEN
        elif self.mask_file is not None:
            raise InputError(f"{self.file} has no pixels for prior.surveys.mask_file")
        factor = (frequency_mhz / self.frequency_mhz) ** self.index
        modes = factor * sky.modes_at(self.frequency_mhz, lmax)
        name = f"{Path(self.file).name} at {self.frequency_mhz:g} MHz"
        return Survey(name, modes, beam, self.scale_std, factor * self.zero_std_k, unseen)


SKY_SECTIONS = kinds_of(GalaxySection, FileSkySection)


def _complete_sky(tree: dict[str, Any]) -> None:
    """Complete ``sky: {file: ...}`` without a model, as in older scenarios."""
    if (tree.get("model") or "galaxy") == "galaxy" and tree.get("file") is not None:
        tree["model"] = "file"


# not strict: older scenarios also gave ``sources`` with a file, where they had no effect
SkySection = one_of(SKY_SECTIONS, _complete_sky, strict=False)


# origin of C_ell
LEARNED = "learned from these data"


class IsotropicPriorSection(SpectrumSection):
    """Independent coefficients, mean 0; C_ell is learned, the sky's own, or read from a file.

    ``sky`` uses C_ell of the scenario's sky, which is known only in simulations: the paper's
    setting. With this C_ell, or one from a file, you can sample an amplitude and a tilt,
    C_ell A ((ell + 1) / 10)^tilt, or one amplitude for every band of ell.

    Attributes
    ----------
    spectrum : {"learned", "sky"}
        Source of C_ell, if not a file; default: learned, unless another key modifies a known
        C_ell.
    scale : float
        Factor applied to C_ell.
    spectrum_file : str
        Text file of ell and C_ell in K^2, used instead of the scenario's sky.
    mean_file : str
        Prior mean: a HEALPix FITS map in K, in Galactic coordinates.
    file_frequency_mhz : float
        Frequency of the prior's files; default: the scenario's frequency.
    spectral_index : float
        Index for scaling the prior's files from ``file_frequency_mhz`` to the scenario's frequency:
        applied once to the mean, twice to C_ell.
    """

    surveys: ClassVar[tuple[SurveySection, ...]] = ()
    model: Literal["isotropic"] = "isotropic"
    spectrum: Literal["learned", "sky"] = "learned"
    scale: Positive = 1.0
    spectrum_file: str | None = None
    mean_file: str | None = None
    file_frequency_mhz: Megahertz | None = None
    spectral_index: Annotated[float, Field(ge=-20, le=20)] = -2.5

    @model_validator(mode="before")
    @classmethod
    def _known_where_something_acts_on_it(cls, value: Any) -> Any:
        if not isinstance(value, dict) or value.get("spectrum") is not None:
            return value
        acting = ("scale", "mean_file", "log_amplitude_std", "tilt_std", "band_edges")
        acts = any(value.get(name) for name in acting)
        return {**value, "spectrum": "sky" if acts else "learned"}

    _known_where_it_is_changed = requires(
        lambda section: (
            not section.is_learned
            or (not section.samples and section.scale == 1.0 and section.mean_file is None)
        ),
        "scale, mean_file and sampled parameters modify a known C_ell, not a learned one; give "
        "spectrum=sky or a spectrum_file with them",
    )

    @property
    def is_learned(self) -> bool:
        """Whether C_ell is learned from the data."""
        return self.spectrum == "learned" and self.spectrum_file is None

    def family(self, frequency_mhz: float, lmax: int) -> families.PriorFamily | None:
        """The family from which data select a prior, up to lmax; None if C_ell is given."""
        if not self.is_learned:
            return None
        mean = sky_source.galaxy_sky(frequency_mhz, 0, seed=None, sources=()).mean_temperature
        return families.IsotropicFamily.around(mean, lmax)

    def prior(self, sky: sky_source.Sky) -> Prior:
        """The prior, S and mean, at the frequency and up to the lmax of a model sky."""
        read_at = self.file_frequency_mhz or sky.frequency_mhz
        steepening = (sky.frequency_mhz / read_at) ** self.spectral_index
        spectrum = sky.spectrum()
        if self.spectrum_file is not None:
            spectrum = read_spectrum(self.spectrum_file, sky.lmax) * steepening**2
        mean = None
        if self.mean_file is not None:
            path = require_file(self.mean_file, "mean map of the prior", "check prior.mean_file")
            mean = sky_source.read_sky_file(path).modes_at(read_at, sky.lmax) * steepening
        return HarmonicPrior(spectrum * self.scale, mean=mean)

    @property
    def origin(self) -> str:
        """Origin of C_ell."""
        if self.spectrum_file is not None:
            return f"of {self.spectrum_file}"
        return LEARNED if self.is_learned else "of the scenario's own sky"

    @property
    def has_files(self) -> bool:
        """Whether the prior is read from files, which have one frequency."""
        return self.spectrum_file is not None or self.mean_file is not None


class LocalScalesPriorSection(Section):
    """A template plus Gaussian deviations whose strength is learned by position and scale.

    The template is the embedded diffuse Galaxy. The data determine its amplitude, whether the
    catalogue's sources are present, C_ell of the deviations, and how their strength varies with
    the template's brightness, with the Galactic plane and with position.

    Attributes
    ----------
    surveys : tuple of SurveySection
        Surveys of the sky, whose mean replaces the template.
    sources : bool
        Allow for the sources of the catalogue.
    """

    # as for the isotropic prior
    origin: ClassVar[str] = LEARNED
    has_files: ClassVar[bool] = False
    samples: ClassVar[bool] = False
    is_learned: ClassVar[bool] = True
    model: Literal["local_scales"] = "local_scales"
    surveys: tuple[SurveySection, ...] = ()
    sources: bool = True

    def family(self, frequency_mhz: float, lmax: int) -> families.PriorFamily:
        """The family from which data select a prior, up to lmax."""
        sources = galaxy.BRIGHT_SOURCES if self.sources else ()
        surveys = [one.at(frequency_mhz, lmax) for one in self.surveys]
        return local_scales.embedded_local_scales(frequency_mhz, lmax, sources, surveys=surveys)


PRIOR_SECTIONS = kinds_of(LocalScalesPriorSection, IsotropicPriorSection)


def _complete_prior(tree: dict[str, Any]) -> None:
    """Choose the model by the entries if there is none: isotropic for those of older scenarios."""
    if (set(tree) & set(IsotropicPriorSection.model_fields) - {"model"}) and not tree.get("model"):
        tree["model"] = "isotropic"
    if tree.get("model") != "isotropic" and tree.get("spectrum") == "sky":
        del tree["spectrum"]  # another kind replaces the paper's prior


PriorSection = one_of(PRIOR_SECTIONS, _complete_prior)


# lmax of the fields of the logarithm, over the map's lmax
FINER = 1.5
# largest number of the fields' modes: every round factorises their matrix
MOST_UNKNOWNS = 10_000


class SpectralSection(Section):
    """The prior on skies of several frequencies that are mapped jointly.

    For components, C_ell follows from the scenario's skies; for positive skies it is learned from
    the data.

    Attributes
    ----------
    model : {"components", "positive"}
        A sum of maps with given spectra, or the embedded diffuse Galaxy times the exponential of
        fields, which is positive everywhere.
    components : tuple of str
        Spectra of the maps: a power law, its curvature (times ln nu) and its turnover (times
        1 - exp(-tau), tau = (turnover_mhz / nu)^2.1).
    fields : tuple of str
        Quantities that vary across positive skies: level, spectral index and curvature (times ln nu
        and ln^2 nu), and the optical depth at turnover_mhz, which scales as nu^-2.1.
    sources : bool
        For positive skies, fit the flux of each catalogue source independently in every channel,
        with an uncertainty equal to the flux.
    index : float
        Spectral index of the components' power law.
    reference_mhz : float
        Reference frequency of the components.
    turnover_mhz : float
        Frequency at which the turnover has optical depth 1.
    residual : float
        rms of the part that is independent in each channel, relative to the rms of its sky;
        default: the part of the skies outside the components. Positive skies have none.
    """

    model: Literal["components", "positive"] = "components"
    components: Annotated[tuple[Component, ...], Field(min_length=1)] = get_args(Component)
    fields: Annotated[tuple[SkyField, ...], Field(min_length=1)] = get_args(SkyField)
    sources: bool = True
    index: Annotated[float, Field(ge=-20, le=20)] = -2.5
    reference_mhz: Megahertz = 20.0
    turnover_mhz: Megahertz = 5.0
    residual: Annotated[float, Field(ge=0, le=1)] | None = None

    @model_validator(mode="before")
    @classmethod
    def _before_the_kernel_went(cls, tree: Any) -> Any:
        """Scenarios of 0.1 contained its length, also where it had no effect."""
        items = tree.items() if isinstance(tree, dict) else ()
        return {key: value for key, value in items if (key, value) != ("length", 1.0)} or tree

    def require_channels(self, n: int) -> None:
        """Raise InputError if there are too few channels to share a posterior."""
        if self.model == "components":
            check_components(self.components, n, self.residual)
        if self.model == "positive":
            PositiveSkies.require_fields(self.fields, n)

    def lmax_of_fields(self, lmax: int) -> int:
        """Choose lmax of the fields: 1.5 times the map's, if the unknowns are not too many.

        Structure that a map does not resolve still changes it where the sky is steep.

        Parameters
        ----------
        lmax : int
            Highest ell of the map.

        Raises
        ------
        InputError
            If fields up to the map's lmax already have too many unknowns.
        """
        if (highest := int(np.sqrt(MOST_UNKNOWNS / len(self.fields))) - 1) < lmax:
            raise InputError(
                f"positive joint skies of lmax {lmax} have "
                f"{len(self.fields) * harmonics.n_modes(lmax)} unknowns, more than the "
                f"{MOST_UNKNOWNS} of one solution; use lmax={highest}, fewer spectral.fields, or "
                "spectral.model=components"
            )
        return min(round(FINER * lmax), highest)

    def positive_skies(self, frequencies_mhz: tuple[float, ...], lmax: int) -> PositiveSkies:
        """The skies of channels up to lmax as functions of the fields.

        Raises
        ------
        InputError
            As in :meth:`lmax_of_fields`.
        """
        catalogue = galaxy.BRIGHT_SOURCES if self.sources else ()
        modes = [[source.modes(f, lmax) for source in catalogue] for f in frequencies_mhz]
        sources = np.reshape(modes, (len(modes), len(catalogue), harmonics.n_modes(lmax)))
        templates = [partial(galaxy.diffuse_brightness, f) for f in frequencies_mhz]
        options = self.model_dump(include={"reference_mhz", "turnover_mhz"})
        options |= {"weight": galaxy.galactic_share, "lmax_fields": self.lmax_of_fields(lmax)}
        skies = np.array(frequencies_mhz), templates, lmax, self.fields
        return PositiveSkies.of(*skies, sources=sources, **options)

    @property
    def n_maps(self) -> int:
        """Number of maps from which the skies of all channels are composed."""
        return len(self.fields if self.model == "positive" else self.components)

    def prior(self, frequencies_mhz: np.ndarray, skies: np.ndarray) -> SpectralPrior:
        """The prior on linear skies of all channels; ``skies`` (channels, modes) model them."""
        given = self.model_dump(include={"index", "reference_mhz", "turnover_mhz", "residual"})
        return SpectralPrior.components(frequencies_mhz, skies, self.components, **given)
