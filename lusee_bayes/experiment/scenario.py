"""A scenario: everything that determines a run, as YAML, validated before anything is computed.

``--set key.path=value`` changes one entry. A mistake in a scenario is reported in one sentence; for
an unknown key it names the nearest known one. ``to_yaml`` writes the resolved scenario with its
defaults; running that file again gives the same numbers.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from functools import lru_cache
from importlib import resources
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, get_args

from pydantic import BaseModel, Field, ValidationError, field_validator, model_validator

from lusee_bayes.core import files, reading
from lusee_bayes.core.errors import InputError, nearest, require_known
from lusee_bayes.core.section import Frequency, Section, Seed
from lusee_bayes.experiment import instrument_sections, sky_sections
from lusee_bayes.flight.recipe import FlightSection
from lusee_bayes.systematics import field_errors, registered
from lusee_bayes.systematics.above_lmax import AboveLmaxSection
from lusee_bayes.systematics.beam import BeamErrorSection
from lusee_bayes.systematics.sources import SourcesSection


def apply_override(tree: dict[str, Any], override: str) -> None:
    """Set one entry of ``tree``; list entries by number, as in observation.runs.0.cycles=2.

    InputError, naming the override, if it is not of the form key.path=value or has no such place.
    """
    key, separator, text = override.partition("=")
    if not separator or not key:
        raise InputError(f"--set takes key.path=value, got '{override}'")
    *parents, last = key.split(".")
    node: Any = tree
    for parent in parents:
        place = _place(node, parent, override)
        if isinstance(node, dict) and node.get(place) is None:
            node[place] = {}
        node = node[place]
        if not isinstance(node, dict | list):
            raise InputError(f"--set {override}: '{parent}' is a value, not a section")
    node[_place(node, last, override)] = reading.parse_yaml(text, f"--set {override}: the value")


def _place(node: dict[str, Any] | list[Any], key: str, override: str) -> int | str:
    """The place of an entry: its key in a section, its number in a list."""
    if isinstance(node, dict):
        return key
    if not (key.isascii() and key.isdigit() and len(key) < 10) or int(key) >= len(node):
        raise InputError(f"--set {override}: '{key}' is not one of the entries 0..{len(node) - 1}")
    return int(key)


def one_sentence(error: ValidationError, source: str | Path) -> str:
    """Describe an unknown key, or else the first mistake: entry, value and the expected one.

    Parameters
    ----------
    error : ValidationError
        Error of pydantic.
    source : str or path
        Origin of the scenario.
    """
    # a misspelt key is also missing
    first = min(error.errors(), key=lambda one: one["type"] != "extra_forbidden")
    path, sections = _resolved(first["loc"])
    where = ".".join(path)
    if first["type"] == "extra_forbidden":
        keys = {name for section in sections for name in section.model_fields}
        return f"{source}: unknown key '{where}'; {nearest(path[-1], keys)}"
    more = f" (and {error.error_count() - 1} more)" if error.error_count() > 1 else ""
    if first["type"] == "union_tag_invalid":
        models = first["ctx"]["expected_tags"].replace("'", "").split(", ")
        got = first["ctx"]["tag"]
        return f"{source}: {where}.model is '{got}', which is unknown; {nearest(got, models)}{more}"
    if first["type"] == "missing":
        return f"{source}: {where} is missing{more}"
    expected = first["msg"].removeprefix("Value error, ")
    expected = expected[0].lower() + expected[1:]
    if first["type"] == "value_error" and isinstance(first["input"], (dict, BaseModel)):
        return f"{source}: {where}: {expected}{more}" if where else f"{source}: {expected}{more}"
    if first["type"] in ("model_type", "model_attributes_type", "dict_type"):
        # pydantic's message names the class
        expected = "it should be a section with keys; lusee-bayes keys lists them"
    # YAML has lists where sections have tuples
    expected = expected.replace("a valid tuple", "a list")
    got = list(first["input"]) if isinstance(first["input"], tuple) else first["input"]
    return f"{source}: {where} is {got!r}, but {expected}{more}"


def _resolved(location: tuple[int | str, ...]) -> tuple[list[str], list[type[BaseModel]]]:
    """The path as a user writes it, and all kinds of the section that contains its last key.

    For a section with several kinds, pydantic inserts the ``model`` into the path. The key may be
    meant for another kind: ``sky.fil=X`` is read as a key of the galaxy.
    """
    path: list[str] = []
    sections = inner = [Scenario]
    kinds: set[str] = set()
    for key in location:
        if key in kinds:
            kinds = set()
            continue
        path.append(str(key))
        fields = [one.model_fields[key] for one in inner if key in one.model_fields]
        models = [section for field in fields for section in _models_in(field.annotation)]
        kinds = {one.model_fields["model"].default for one in models if len(models) > 1}
        sections, inner = inner, models or inner
    return path, sections


def _models_in(annotation: Any) -> list[type[BaseModel]]:
    """Every section in the type of a field."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [model for part in get_args(annotation) for model in _models_in(part)]


# the scenarios that ship with the package
FOLDER = resources.files("lusee_bayes.experiment") / "scenarios"


class OutputSection(Section):
    """Optional results.

    Attributes
    ----------
    draws : int
        Number of posterior draws to store in ``posterior.nc``.
    covariance : bool
        Store the posterior covariance in ``posterior.nc``.
    information : bool
        Store the data's information about the sky in ``posterior.nc``, for adding data later.
    """

    draws: Annotated[int, Field(ge=0)] = 0
    covariance: bool = False
    information: bool = False


class Scenario(Section):
    """A complete run at one frequency, or at all of ``frequencies_mhz``.

    Attributes
    ----------
    frequency_mhz : float
        Frequency of the map.
    frequencies_mhz : tuple of float
        Channels of a run at several frequencies, in increasing order.
    joint : bool
        Fit one posterior to all channels with the spectral prior; by default, map each channel
        independently.
    lmax : int
        Highest ell of the map, which has (lmax + 1)^2 modes.
    nside : int
        HEALPix NSIDE of written maps; default: the lowest with two pixels per ell.
    observation : ObservationSection
        Site and times.
    beam : BeamSection
        The antennas.
    sky : SkySection
        True sky of simulated data, and the sky model that sets the noise level.
    prior : PriorSection
        Prior on the sky (S).
    noise : NoiseSection
        Noise and systematics (N).
    sources : SourcesSection
        Point sources that are not part of the map.
    spectral : SpectralSection
        Prior on the skies of joint channels.
    flight : FlightSection
        Reduction of spectrometer sessions to visibilities.
    output : OutputSection
        Optional results.
    seed : int
        Seed for simulated data and draws.
    instrument_seed : int
        Seed for the part of the simulated instrument that all channels share; default: ``seed``.
        In a run at several frequencies, all channels use the same seed.
    """

    frequency_mhz: Frequency = 25.0
    frequencies_mhz: Annotated[tuple[Frequency, ...], Field(max_length=4096)] = ()
    joint: bool = False
    lmax: Annotated[int, Field(ge=1, le=383)] = 47
    nside: Annotated[int, Field(ge=1, le=8192)] | None = None
    observation: instrument_sections.ObservationSection = instrument_sections.ObservationSection()
    beam: instrument_sections.BeamSection = instrument_sections.MonopoleBeamSection()
    sky: sky_sections.SkySection = sky_sections.GalaxySection()
    prior: sky_sections.PriorSection = sky_sections.LocalScalesPriorSection()
    noise: registered.NoiseSection = registered.NoiseSection()
    sources: SourcesSection = SourcesSection()
    spectral: sky_sections.SpectralSection = sky_sections.SpectralSection()
    flight: FlightSection | None = None
    output: OutputSection = OutputSection()
    seed: Seed = 1
    instrument_seed: Seed | None = None

    @model_validator(mode="before")
    @classmethod
    def _one_frequency_is_no_list(cls, tree: Any) -> Any:
        many = tree.get("frequencies_mhz") if isinstance(tree, Mapping) else None
        if isinstance(many, Sequence) and len(many) == 1 and not tree.get("joint"):
            return {**tree, "frequency_mhz": many[0], "frequencies_mhz": ()}
        return tree

    @field_validator("nside")
    @classmethod
    def _nside_is_healpix(cls, nside: int | None) -> int | None:
        if nside is not None and nside & (nside - 1):
            raise ValueError("expected a power of two, as HEALPix requires")
        return nside

    @model_validator(mode="after")
    def _sections_agree(self) -> Scenario:
        many, own_sources = self.frequencies_mhz, self.sources.list
        prior, error = self.prior, self.noise.beam
        if any(b <= a for a, b in pairwise(many)):
            raise ValueError("frequencies_mhz must increase")
        if self.joint and not many:
            raise ValueError("joint needs frequencies_mhz, the channels that share a posterior")
        if self.joint:
            self.spectral.require_channels(len(many))
        if self.sky.sources and own_sources:
            wrong = "the embedded sky has sources; for your own sources.list set sky.sources=false"
            raise ValueError(wrong)
        if error is not None and error.parameters and not self.beam.has_parameters:
            raise ValueError(
                "noise.beam.parameters describe the embedded antennas, which beam.file replaces; "
                "use noise.beam.shift_mhz or noise.beam.file, or a grid of files (beam.model=grid)"
            )
        if self.joint and (prior.has_files or prior.surveys or getattr(prior, "scale", 1.0) != 1.0):
            wrong = "joint uses the spectral prior; remove files, surveys and scale of the prior"
            raise ValueError(wrong)
        if many and prior.has_files and prior.file_frequency_mhz is None:
            wrong = "files of the prior are for one frequency; give it as prior.file_frequency_mhz"
            raise ValueError(wrong)
        return self

    @property
    def shared(self) -> dict[str, float]:
        """Unknowns of the instrument that channels share, with the octaves over which they do."""
        if not self.frequencies_mhz:
            return {}
        return {
            cls.words: octaves
            for cls, section in registered.present(self)
            if cls.treatment(self) != "ignored" and (octaves := cls.octaves(section))
        }

    def of_measured(self) -> Scenario:
        """The scenario for measured data: beams have unknowns unless declared exact.

        The sky extends above lmax.
        """
        if self.noise.above_lmax is None:
            return self.with_section("noise", above_lmax=AboveLmaxSection()).of_measured()
        if self.beam.exact or self.noise.beam is not None or self.noise.fields is not None:
            return self
        sizes = {name: error * getattr(self.beam, name) for name, error in self.beam.errors.items()}
        stds = {name: std for name, std in sizes.items() if std > 0.0}
        beam = BeamErrorSection(parameters=stds) if stds else None
        fields = field_errors.FieldErrorsSection() if self.beam.source().has_fields else None
        return self.with_section("noise", beam=beam, fields=fields)

    def with_section(self, name: str, **values: object) -> Scenario:
        """Return the scenario with some values of a section changed."""
        return self.model_copy(update={name: getattr(self, name).model_copy(update=values)})

    @property
    def single(self) -> bool:
        """Whether the scenario has one frequency."""
        return not self.frequencies_mhz

    def channels(self) -> tuple[Scenario, ...]:
        """The scenario of every channel; seeds increase by one from channel to channel."""
        alone: dict[str, Any] = {"frequencies_mhz": (), "joint": False}
        if self.joint:  # the spectral prior uses C_ell of the sky
            alone["prior"] = sky_sections.IsotropicPriorSection(spectrum="sky")
        seed = self.instrument_seed
        alone["instrument_seed"] = self.seed if seed is None else seed
        return tuple(
            self.model_copy(update={**alone, "frequency_mhz": f, "seed": self.seed + number})
            for number, f in enumerate(self.frequencies_mhz)
        )

    @property
    def samples(self) -> bool:
        """Whether anything besides the sky is sampled."""
        return "sampled" in {cls.treatment(self) for cls in registered.SYSTEMATICS}

    def require_marginal(self, what: str, advice: str) -> None:
        """Raise InputError if anything is sampled, for commands that can only marginalise."""
        if self.samples:
            wrong = f"something is to be sampled, but {what} can only marginalise; {advice}"
            raise InputError(wrong)

    def require_single(self, what: str) -> None:
        """Raise InputError for several frequencies, for commands with one."""
        if not self.single:
            raise InputError(f"{what} one frequency; give frequency_mhz instead of frequencies_mhz")

    @property
    def map_nside(self) -> int:
        """NSIDE of written maps: at least two pixels per ell."""
        return self.nside or 2 ** max(3, (self.lmax // 2).bit_length())

    def to_yaml(self) -> str:
        """The resolved scenario, including defaults."""
        return _as_yaml(json.dumps(self.model_dump(mode="json")))


# a run writes the same scenario into each of its files
_as_yaml = lru_cache(maxsize=64)(lambda text: reading.as_yaml(json.loads(text)))


def scenario_names() -> list[str]:
    """Names of the built-in scenarios."""
    names = (entry.name for entry in FOLDER.iterdir())
    return sorted(name.removesuffix(".yaml") for name in names if name.endswith(".yaml"))


def scenario_text(name: str) -> str:
    """The YAML of a built-in scenario. InputError for an unknown name."""
    require_known("the package has no scenario", name, scenario_names())
    return (FOLDER / f"{name}.yaml").read_text(encoding="utf-8")


def load_scenario(source: str | Path | Scenario, overrides: Sequence[str] = ()) -> Scenario:
    """Read a YAML file, or a built-in scenario by name, and apply ``key.path=value``.

    A Scenario is accepted as it is, so that runs accept a scenario, its file or its name.

    InputError with one sentence for a missing file, bad YAML, an unknown key or a bad value.
    """
    scenario = source if isinstance(source, Scenario) else _validate(_read_yaml(source), source)
    if not overrides:
        return scenario
    tree = scenario.model_dump(mode="json")  # includes defaults, so that any entry can be set
    for override in overrides:
        apply_override(tree, override)
    return _validate(tree, "the scenario" if isinstance(source, Scenario) else source)


def _validate(tree: dict[Any, Any], source: str | Path) -> Scenario:
    try:
        return Scenario.model_validate(tree)
    except ValidationError as error:
        raise InputError(one_sentence(error, source)) from error


def _read_yaml(source: str | Path) -> dict[Any, Any]:
    names, path = scenario_names(), files.user_path(source)
    if os.path.isfile(path) or (os.path.exists(path) and str(source) not in names):
        tree = reading.read_yaml(path, "a scenario")
    elif str(source) in names:
        tree = reading.parse_yaml(scenario_text(str(source)), str(source))
    elif os.sep in str(source) or Path(source).suffix[1:2].isalpha():
        wrong = f"no scenario file at '{source}'; check the path, or name one of the package"
        raise InputError(wrong)
    else:
        wrong = f"no scenario '{source}': neither a file nor a name; {nearest(str(source), names)}"
        raise InputError(wrong)
    tree = {} if tree is None else tree
    if not isinstance(tree, dict):
        raise InputError(f"{source} must contain keys and values, got a {type(tree).__name__}")
    return tree
