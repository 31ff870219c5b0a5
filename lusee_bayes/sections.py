"""The sections of a scenario: what can be said, with which defaults, and what goes together."""

from __future__ import annotations

from datetime import date
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, field_validator, model_validator

Positive = Annotated[float, Field(gt=0)]
# of LuSEE-Night's band, in MHz
Frequency = Annotated[float, Field(ge=1, le=50)]


class Section(BaseModel):
    """Part of a scenario: no key that is not declared, no NaN, nothing changed once made."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class RunSection(Section):
    """One stretch of data at one turntable angle."""

    cycles: Positive = 1.0
    turntable_deg: float = 0.0
    night_only: bool = False


class ObservationSection(Section):
    """Where and when; ``runs`` follow one another from ``start`` (UTC).

    ``fixed_axis``: the Moon turns about the axis of the first sample, as luseepy's default engines
    have it; for data that they have made.
    """

    lon_deg: float = 182.258
    lat_deg: Annotated[float, Field(ge=-90, le=90)] = -23.814
    start: str = "2027-01-15T00:00:00"
    step_s: Positive = 7200.0
    runs: Annotated[tuple[RunSection, ...], Field(min_length=1)] = (RunSection(),)
    fixed_axis: bool = False

    @field_validator("start", mode="before")
    @classmethod
    def _as_text(cls, value: Any) -> Any:
        """YAML reads an unquoted date as a date."""
        return value.isoformat() if isinstance(value, date) else value


# what only the embedded antennas have
EMBEDDED = (
    "length_m",
    "zenith_angle_deg",
    "height_m",
    "surface_permittivity",
    "deep_permittivity",
    "loss_tangent",
)


class BeamSection(Section):
    """The embedded monopoles and the ground under them, or the beams of ``file``.

    ``file``: a scalar beam of luseepy, put up once for each of ``rotations_deg`` (from East towards
    North, on top of ``turntable_offset_deg``), faded out towards the horizon as luseepy does if
    ``taper``; or a four-port response of luseepy, with ``receiver`` on its ports. Ground of
    ``moon_temperature_k`` (and antennas of ``antenna_temperature_k``, where the response has
    losses) add their own radiation. ``quadrature: luseepy`` is luseepy's own rule, for data that
    luseepy has made.
    """

    model: Literal["monopole"] = "monopole"
    length_m: Positive = 3.0
    zenith_angle_deg: Annotated[float, Field(gt=0, lt=180)] = 75.0
    height_m: Positive = 2.0
    surface_permittivity: Annotated[float, Field(ge=1)] = 3.7
    deep_permittivity: Annotated[float, Field(ge=1)] = 6.1
    loss_tangent: Annotated[float, Field(ge=0)] = 0.01
    turntable_offset_deg: float = 0.0
    file: str | None = None
    taper: bool = True
    quadrature: Literal["exact", "luseepy"] = "exact"
    receiver: Literal["jfet", "open"] = "jfet"
    moon_temperature_k: Annotated[float, Field(ge=0)] = 0.0
    antenna_temperature_k: Annotated[float, Field(ge=0)] = 0.0
    rotations_deg: Annotated[tuple[float, ...], Field(min_length=1)] = (0.0, 90.0, 180.0, 270.0)

    @model_validator(mode="after")
    def _one_kind(self) -> BeamSection:
        for name in EMBEDDED:
            default = type(self).model_fields[name].default
            if self.file is not None and getattr(self, name) != default:
                raise ValueError(f"{name} is a parameter of the embedded antennas, not of a file")
        if self.file is None and (self.moon_temperature_k or self.antenna_temperature_k):
            raise ValueError(
                "the beams of the embedded antennas are scaled to the sky alone: temperatures of "
                "Moon and antennas need beam.file"
            )
        return self


class SkySection(Section):
    """The embedded Galaxy, or a sky from ``file``.

    Files: ULSA's HDF5, HEALPix FITS, luseepy's FITS of many maps, healpy's coefficients.

    ``sources`` adds the brightest point sources to the embedded Galaxy, not to a file.

    A file made for ``file_frequency_mhz`` is scaled with ``spectral_index`` (of files with many
    frequencies, that one is taken); by default it is taken to be at the scenario's frequency.
    """

    model: Literal["galaxy"] = "galaxy"
    seed: Annotated[int, Field(ge=0)] = 1
    sources: bool = True
    file: str | None = None
    dataset: str | None = None
    file_frequency_mhz: Positive | None = None
    spectral_index: float = -2.5


class PriorSection(Section):
    """C_ell of the prior: the spectrum of the scenario's sky, times ``scale``.

    Sampled where they are not known: ln of an amplitude and a tilt, C_ell A ((ell + 1) / 10)^tilt,
    of prior standard deviations ``log_amplitude_std`` and ``tilt_std``; or (``band_edges``: first
    ell of each band but the lowest) ln of one amplitude for every band, of ``log_band_std``.
    """

    spectrum: Literal["sky"] = "sky"
    scale: Positive = 1.0
    log_amplitude_std: Positive | None = None
    tilt_std: Positive | None = None
    band_edges: tuple[Annotated[int, Field(ge=1)], ...] = ()
    log_band_std: Positive = 1.0

    @model_validator(mode="after")
    def _one_parameterisation(self) -> PriorSection:
        if self.band_edges and (self.log_amplitude_std or self.tilt_std):
            raise ValueError("give either band_edges or log_amplitude_std and tilt_std")
        if list(self.band_edges) != sorted(set(self.band_edges)):
            raise ValueError("band_edges must grow from one to the next")
        return self


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


Treatment = Literal["marginalised", "sampled", "ignored"]


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

    shift_mhz: float | None = None
    file: str | None = None
    parameters: dict[str, Positive] = {}
    treatment: Treatment = "marginalised"

    @model_validator(mode="after")
    def _one_direction(self) -> BeamErrorSection:
        if (self.shift_mhz is not None) + (self.file is not None) + bool(self.parameters) != 1:
            raise ValueError("give either shift_mhz, file or parameters")
        return self


class SourceSection(Section):
    """A point source, apart from the map: one of the catalogue, a body of the solar system, or own.

    ``flux_jy`` is the mean of its prior (the catalogue's, if left out), ``relative_std`` its
    standard deviation in units of the mean. Own sources give ``ra_deg`` and ``dec_deg`` (ICRS).
    ``stokes_v``: circularly polarised part V / I. ``block_h``: an amplitude for each block of so
    many hours, independently; without it one for all times.
    """

    name: str
    flux_jy: Positive | None = None
    relative_std: Positive = 0.5
    ra_deg: float | None = None
    dec_deg: Annotated[float, Field(ge=-90, le=90)] | None = None
    stokes_v: Annotated[float, Field(ge=-1, le=1)] = 0.0
    block_h: Positive | None = None

    @model_validator(mode="after")
    def _both_coordinates(self) -> SourceSection:
        if (self.ra_deg is None) != (self.dec_deg is None):
            raise ValueError("give both ra_deg and dec_deg, or none")
        return self


class SourcesSection(Section):
    """Point sources that are not part of the map: in N, sampled, or ignored."""

    list: tuple[SourceSection, ...] = ()
    treatment: Treatment = "marginalised"

    @model_validator(mode="after")
    def _names_differ(self) -> SourcesSection:
        names = [source.name for source in self.list]
        if len(set(names)) < len(names):
            twice = next(name for name in names if names.count(name) > 1)
            raise ValueError(f"the source '{twice}' is there twice")
        return self


class NoiseSection(Section):
    """The terms of N; a term that is left out is neither in the data nor in N."""

    radiometer: RadiometerSection = RadiometerSection()
    gain: GainSection | None = None
    beam: BeamErrorSection | None = None


class SpectralSection(Section):
    """The prior on skies of several frequencies that are mapped together.

    ``components``: maps with the spectra of a power law of ``index``, its curvature (times ln nu)
    and its turnover (times 1 - exp(-tau), tau = (``turnover_mhz`` / nu)^2.1). ``kernel``: the power
    law times a Gaussian process in ln nu of the given ``length``. C_ell follow from the scenario's
    skies. ``residual``: rms of what each channel has of its own, over that of its sky; by default
    what the components leave of the skies, 0.01 with the kernel. ``solver``: conjugate gradients
    where the direct one would not fit.
    """

    model: Literal["components", "kernel"] = "components"
    components: Annotated[
        tuple[Literal["power_law", "curvature", "turnover"], ...], Field(min_length=1)
    ] = ("power_law", "curvature", "turnover")
    index: float = -2.5
    reference_mhz: Positive = 20.0
    turnover_mhz: Positive = 5.0
    length: Positive = 1.0
    residual: Annotated[float, Field(ge=0, le=1)] | None = None
    solver: Literal["auto", "direct", "conjugate_gradients"] = "auto"
    tolerance: Positive = 1e-7
    iterations: Annotated[int, Field(ge=1)] = 500
