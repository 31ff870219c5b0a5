"""A scenario: everything that determines a run, as YAML, validated before anything is computed.

Unknown keys are errors that name the nearest known one. ``to_yaml`` writes the resolved scenario,
defaults included; running that file again gives the same numbers.
"""

from __future__ import annotations

from datetime import date
from importlib import resources
from pathlib import Path
from typing import Annotated, Any, Literal

import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator, model_validator

from lusee_bayes.checks import InputError, nearest
from lusee_bayes.overrides import apply_override

Positive = Annotated[float, Field(gt=0)]


class Section(BaseModel):
    """Part of a scenario: no key that is not declared, no NaN, nothing changed once made."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class RunSection(Section):
    """One stretch of data at one turntable angle."""

    cycles: Positive = 1.0
    turntable_deg: float = 0.0
    night_only: bool = False


class ObservationSection(Section):
    """Where and when; ``runs`` follow one another from ``start`` (UTC)."""

    lon_deg: float = 182.258
    lat_deg: Annotated[float, Field(ge=-90, le=90)] = -23.814
    start: str = "2027-01-15T00:00:00"
    step_s: Positive = 7200.0
    runs: Annotated[tuple[RunSection, ...], Field(min_length=1)] = (RunSection(),)

    @field_validator("start", mode="before")
    @classmethod
    def _as_text(cls, value: Any) -> Any:
        """YAML reads an unquoted date as a date."""
        return value.isoformat() if isinstance(value, date) else value


class BeamSection(Section):
    """The embedded monopoles and the ground under them."""

    model: Literal["monopole"] = "monopole"
    length_m: Positive = 3.0
    zenith_angle_deg: Annotated[float, Field(gt=0, lt=180)] = 75.0
    height_m: Positive = 2.0
    surface_permittivity: Annotated[float, Field(ge=1)] = 3.7
    deep_permittivity: Annotated[float, Field(ge=1)] = 6.1
    loss_tangent: Annotated[float, Field(ge=0)] = 0.01


class SkySection(Section):
    """The embedded Galaxy, or a map from ``file`` (ULSA HDF5 or HEALPix FITS).

    ``sources`` adds the brightest point sources to the embedded Galaxy, not to a file.

    A file made for ``file_frequency_mhz`` is scaled with ``spectral_index``; by default it is
    taken to be at the scenario's frequency.
    """

    model: Literal["galaxy"] = "galaxy"
    seed: Annotated[int, Field(ge=0)] = 1
    sources: bool = True
    file: str | None = None
    dataset: str | None = None
    file_frequency_mhz: Positive | None = None
    spectral_index: float = -2.5


class PriorSection(Section):
    """C_ell of the prior: the spectrum of the scenario's sky, times ``scale``."""

    spectrum: Literal["sky"] = "sky"
    scale: Positive = 1.0


class RadiometerSection(Section):
    """Radiometer noise; ``temperature`` says whose visibilities set its level."""

    form: Literal["paper", "exact"] = "paper"
    bandwidth_hz: Positive = 1.0e6
    duty_cycle: Annotated[float, Field(gt=0, le=1)] = 1.0
    factor: Positive = 1.0
    temperature: Literal["model", "measured"] = "model"


Treatment = Literal["marginalised", "ignored"]


class GainSection(Section):
    """Gain drifts in the data; ``marginalised`` puts their covariance into N, ``ignored`` not.

    ``visibilities``: the d that the covariance is built around. ``measured`` data hold the drifts
    themselves, which moves the map by about a standard deviation; ``posterior`` starts from them
    and repeats with the map's prediction until the map stops moving, which mends that.
    """

    sigma: Positive = 0.01
    correlation_h: Positive = 10.0
    treatment: Treatment = "marginalised"
    visibilities: Literal["model", "measured", "posterior"] = "model"


class BeamErrorSection(Section):
    """Beams that differ from the model's in the data; marginalised in N or ignored.

    ``shift_mhz``: the data are taken with the beams of frequency + shift. ``parameters``: standard
    deviations of parameters of the embedded antennas, whose errors are drawn with the seed.
    """

    shift_mhz: float | None = None
    parameters: dict[str, Positive] = {}
    treatment: Treatment = "marginalised"

    @model_validator(mode="after")
    def _one_direction(self) -> BeamErrorSection:
        if (self.shift_mhz is None) == (not self.parameters):
            raise ValueError("give either shift_mhz or parameters")
        return self


class NoiseSection(Section):
    """The terms of N; a term that is left out is neither in the data nor in N."""

    radiometer: RadiometerSection = RadiometerSection()
    gain: GainSection | None = None
    beam: BeamErrorSection | None = None


class Scenario(Section):
    """A complete run."""

    frequency_mhz: Annotated[float, Field(ge=1, le=50)] = 25.0
    lmax: Annotated[int, Field(ge=1, le=383)] = 47
    nside: Annotated[int, Field(ge=1)] | None = None
    observation: ObservationSection = ObservationSection()
    beam: BeamSection = BeamSection()
    sky: SkySection = SkySection()
    prior: PriorSection = PriorSection()
    noise: NoiseSection = NoiseSection()
    seed: Annotated[int, Field(ge=0)] = 1

    @property
    def map_nside(self) -> int:
        """NSIDE of maps that leave the program: at least two pixels for each ell."""
        if self.nside is not None:
            return self.nside
        return 2 ** max(3, (self.lmax // 2).bit_length())

    def to_yaml(self) -> str:
        """The resolved scenario, defaults included."""
        return yaml.safe_dump(self.model_dump(mode="json"), sort_keys=False)


def scenario_names() -> list[str]:
    """Names of the scenarios that ship with the package."""
    folder = resources.files("lusee_bayes") / "scenarios"
    return sorted(
        p.name.removesuffix(".yaml") for p in folder.iterdir() if p.name.endswith(".yaml")
    )


def load_scenario(source: str | Path, overrides: list[str] | tuple[str, ...] = ()) -> Scenario:
    """Read a YAML file, or a scenario of the package by name, and apply ``key.path=value``.

    InputError with one sentence for a missing file, bad YAML, an unknown key or a bad value.
    """
    scenario = _validate(_read_yaml(source), source)
    if not overrides:
        return scenario
    tree = scenario.model_dump(mode="json")  # defaults included, so that any entry can be set
    for override in overrides:
        apply_override(tree, override)
    return _validate(tree, source)


def _validate(tree: dict[str, Any], source: str | Path) -> Scenario:
    try:
        return Scenario.model_validate(tree)
    except ValidationError as error:
        raise InputError(_one_sentence(error, str(source))) from error


def _read_yaml(source: str | Path) -> dict[str, Any]:
    path = Path(source)
    if path.is_file():
        text = path.read_text()
    elif str(source) in scenario_names():
        text = (resources.files("lusee_bayes") / "scenarios" / f"{source}.yaml").read_text()
    else:
        raise InputError(
            f"no scenario '{source}': neither a file nor a name; "
            f"{nearest(str(source), scenario_names())}"
        )
    try:
        tree = yaml.safe_load(text)
    except yaml.YAMLError as error:
        raise InputError(f"{source} is not valid YAML: {' '.join(str(error).split())}") from error
    tree = {} if tree is None else tree
    if not isinstance(tree, dict):
        raise InputError(f"{source} must hold keys and values, got a {type(tree).__name__}")
    return tree


def _section_at(location: tuple[int | str, ...]) -> type[BaseModel] | None:
    """The section that a key of a validation error belongs to."""
    model: Any = Scenario
    for key in location:
        if isinstance(key, int):
            continue
        field = model.model_fields.get(key)
        if field is None:
            return None
        kinds = [field.annotation, *getattr(field.annotation, "__args__", ())]
        model = next((k for k in kinds if isinstance(k, type) and issubclass(k, BaseModel)), None)
        if model is None:
            return None
    return model


def _one_sentence(error: ValidationError, source: str) -> str:
    """What was found, what was expected and where, for the first thing that is wrong."""
    first = error.errors()[0]
    where = ".".join(str(part) for part in first["loc"])
    if first["type"] == "extra_forbidden":
        section = _section_at(first["loc"][:-1])
        known = list(section.model_fields) if section else []
        return f"{source}: unknown key '{where}'; {nearest(str(first['loc'][-1]), known)}"
    more = f" (and {error.error_count() - 1} more)" if error.error_count() > 1 else ""
    expected = first["msg"].removeprefix("Value error, ")
    expected = expected[0].lower() + expected[1:]
    return f"{source}: {where} is {first['input']!r}, but {expected}{more}"
