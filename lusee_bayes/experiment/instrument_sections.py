"""Sections of a scenario on the instrument.

They specify site, times and turntable angles, the beams, and the receivers at their ports. A
section in :mod:`lusee_bayes.flight.recipe` specifies how spectrometer sessions become visibilities.
Beams and receivers have one section per kind, selected by ``model``; those of receivers are in
:mod:`lusee_bayes.instrument.beams.source`. To add a kind of beams, write a subclass of
:class:`BaseBeamSection` here, with its :class:`BeamSource`, and add it to ``BEAM_SECTIONS``.
"""

from collections.abc import Mapping
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

from pydantic import Field, model_validator

from lusee_bayes.core.section import Angle, Positive, Section, Temperature, kinds_of, one_of
from lusee_bayes.instrument.beams import fields, grid, sampled
from lusee_bayes.instrument.beams.luseepy_files import read_response, read_scalar_beam
from lusee_bayes.instrument.beams.monopoles import Monopoles, Regolith
from lusee_bayes.instrument.beams.source import BeamSource, ReceiverSection
from lusee_bayes.instrument.observation import Observation
from lusee_bayes.instrument.schedule import CYCLE_DAYS, Interval, Run, read_schedule
from lusee_bayes.instrument.times import Timestamp


class RunSection(Section):
    """A continuous stretch of data at one turntable angle.

    Attributes
    ----------
    cycles : float
        Duration in lunar cycles of 27.321661 days.
    turntable_deg : float
        Turntable angle, from East towards North.
    night_only : bool
        Exclude samples taken with the Sun above the horizon.
    """

    cycles: Positive = 1.0
    turntable_deg: Angle = 0.0
    night_only: bool = False


class ObservationSection(Section):
    """Site and times: consecutive ``runs`` from ``start``, or the dates in a ``schedule``.

    Attributes
    ----------
    lon_deg : float
        Longitude of the site on the Moon (MCMF).
    lat_deg : float
        Latitude of the site on the Moon (MCMF).
    start : str
        Start of the first sample, UTC, for example 2027-01-15T00:00:00.
    step_s : float
        Time between samples.
    window : {"mean", "instant"}
        What a sample represents, unless the data file specifies it: the mean over its step, or the
        sky at its start, as in the paper and in luseepy's simulators.
    timestamp : {"start", "middle", "end", "instant"}
        Point of each sample that the times in a data file mark, unless the file specifies it; each
        window then lasts one step of the file.
    average_s : float
        Average data from a file over this time when reading them.
    runs : tuple of RunSection
        Consecutive stretches of data.
    schedule : str, optional
        File of observing intervals, instead of ``start`` and ``runs``: CSV, or an OpSim command
        table.
    fixed_axis : bool
        Rotate the Moon about its axis at the first sample, as luseepy's ``croissant`` engine does;
        for data simulated with that engine, with ``window: instant``.
    """

    lon_deg: Annotated[float, Field(ge=-360, le=360)] = 182.258
    lat_deg: Annotated[float, Field(ge=-90, le=90)] = -23.814
    start: str = "2027-01-15T00:00:00"
    step_s: Positive = 7200.0
    window: Literal["mean", "instant"] = "mean"
    timestamp: Timestamp | None = None
    average_s: Positive | None = None
    runs: Annotated[tuple[RunSection, ...], Field(min_length=1)] = (RunSection(),)
    schedule: str | None = None
    fixed_axis: bool = False

    @model_validator(mode="before")
    @classmethod
    def _before_there_were_windows(cls, tree: Any) -> Any:
        """Older scenarios, with all entries except this one, had instants."""
        if isinstance(tree, Mapping) and "fixed_axis" in tree and "window" not in tree:
            return {**tree, "window": "instant"}
        return tree

    @model_validator(mode="after")
    def _entries_agree(self) -> "ObservationSection":
        if self.fixed_axis and self.window != "instant":
            raise ValueError("fixed_axis is for samples that are instants; add window: instant")
        if self.schedule is None:
            return self
        for name in ("start", "runs"):
            if getattr(self, name) != type(self).model_fields[name].default:
                raise ValueError(
                    f"schedule {self.schedule} and {name} both set the observing times; remove one"
                )
        return self

    def observation(self) -> Observation:
        """Site, times and turntable angles."""
        return _observation(self, () if self.schedule is None else read_schedule(self.schedule))

    def n_samples(self) -> int:
        """Count the samples, including those by day."""
        if self.schedule is None:
            return sum(int(run.cycles * CYCLE_DAYS * 86400.0 // self.step_s) for run in self.runs)
        return sum(interval.n_samples(self.step_s) for interval in read_schedule(self.schedule))


@lru_cache(maxsize=2)
def _observation(section: ObservationSection, intervals: tuple[Interval, ...]) -> Observation:
    """The observation, cached for all channels with its orientations."""
    common = section.model_dump(include={"step_s", "lon_deg", "lat_deg", "fixed_axis", "window"})
    if intervals:
        return Observation.from_schedule(intervals, **common)
    runs = tuple(Run(r.cycles, r.turntable_deg, r.night_only) for r in section.runs)
    return Observation.from_runs(runs, start=section.start, **common)


class BaseBeamSection(Section):
    """Settings common to all beams.

    Attributes
    ----------
    exact : bool
        Assume exact beams when mapping measured data. By default, if neither ``noise.beam`` nor
        ``noise.fields`` is set, ground, arms and fields are unknowns of the map.
    """

    # whether the beams have parameters that can be unknowns
    has_parameters: ClassVar[bool] = False
    # relative standard deviations of the parameters that are unknown by default
    errors: ClassVar[Mapping[str, float]] = {}

    exact: bool = False

    def of_file(self, file: str) -> Any:
        """The section for the beams in a file, with the settings that it shares with this one."""
        kind = BEAM_SECTIONS[sampled.beam_kind(file)]
        shared = set(kind.model_fields) - {"model", "file", "exact"}
        return kind(file=file, **self.model_dump(include=shared))


class MonopoleBeamSection(BaseBeamSection):
    """The embedded antennas: four monopoles over layered regolith.

    Attributes
    ----------
    length_m : float
        Arm length.
    zenith_angle_deg : float
        Angle of the arms from the zenith.
    height_m : float
        Height of the feed above the ground.
    surface_permittivity : float
        Permittivity of the regolith at the surface.
    deep_permittivity : float
        Permittivity of the regolith at a depth of 100 m.
    loss_tangent : float
        Loss tangent of the regolith.
    turntable_offset_deg : float
        Added to every turntable angle, from East towards North.
    """

    is_file: ClassVar[bool] = False
    has_parameters: ClassVar[bool] = True
    # name for file headers
    label: ClassVar[str] = "monopole"
    errors: ClassVar[Mapping[str, float]] = {
        "surface_permittivity": 0.05,
        "deep_permittivity": 0.05,
        "loss_tangent": 0.3,
        "zenith_angle_deg": 0.007,
        "length_m": 0.003,
        "height_m": 0.01,
    }

    model: Literal["monopole"] = "monopole"
    length_m: Positive = 3.0
    zenith_angle_deg: Annotated[float, Field(gt=0, lt=180)] = 75.0
    height_m: Positive = 2.0
    surface_permittivity: Annotated[float, Field(ge=1, le=1e6)] = 3.7
    deep_permittivity: Annotated[float, Field(ge=1, le=1e6)] = 6.1
    loss_tangent: Annotated[float, Field(ge=0, le=1e6)] = 0.01
    turntable_offset_deg: Angle = 0.0

    def source(self) -> BeamSource:
        """The antennas."""
        ground = {"surface_permittivity", "deep_permittivity", "loss_tangent"}
        others = self.model_dump(exclude={"model", "exact", *ground})
        return Monopoles(regolith=Regolith(**self.model_dump(include=ground)), **others)


class _FileSection(BaseBeamSection):
    """Settings common to beams from files.

    Attributes
    ----------
    turntable_offset_deg : float
        Added to every turntable angle, from East towards North.
    """

    is_file: ClassVar[bool] = True

    file: str
    turntable_offset_deg: Angle = 0.0

    @property
    def label(self) -> str:
        """Name of the antennas, for file headers."""
        return Path(self.file).name


class _LuseepySection(_FileSection):
    """Settings common to beams from luseepy files.

    Attributes
    ----------
    quadrature : {"exact", "luseepy"}
        Quadrature over the sphere; ``luseepy`` is luseepy's own rule, for data simulated with it.
    moon_temperature_k : float
        Temperature of the ground, which adds thermal emission.
    """

    quadrature: Literal["exact", "luseepy"] = "exact"
    interpolation: fields.Interpolation = "linear"
    moon_temperature_k: Temperature = 0.0

    def asked(self) -> dict[str, Any]:
        """Settings of every file, as arguments of its beams."""
        luseepys = self.quadrature == "luseepy"
        options = {"luseepy_quadrature": luseepys, "moon_k": self.moon_temperature_k}
        return options | self.model_dump(include={"interpolation", "turntable_offset_deg"})


class ScalarBeamSection(_LuseepySection):
    """A luseepy scalar beam: the pattern of one arm, reused for every port.

    Attributes
    ----------
    file : str
        luseepy FITS file, version 2.
    rotations_deg : tuple of float
        Rotation of the pattern for each port, from East towards North, in addition to
        ``turntable_offset_deg``.
    taper : bool
        Taper the beam towards the horizon, as luseepy does.
    interpolation : {"linear", "spline"}
        Interpolation between the file's frequencies: linear in products of fields, as in luseepy,
        or cubic splines in the fields.
    """

    model: Literal["luseepy"] = "luseepy"
    taper: bool = True
    rotations_deg: Annotated[tuple[Angle, ...], Field(min_length=1)] = (0.0, 90.0, 180.0, 270.0)

    def source(self) -> BeamSource:
        """The pattern of the file, rotated to every angle."""
        beam, own = read_scalar_beam(self.file), self.model_dump(include={"taper", "rotations_deg"})
        return replace(beam, **own, **self.asked())


class ResponseSection(_LuseepySection):
    """A luseepy four-port response: coupled antennas with their receivers.

    Attributes
    ----------
    file : str
        luseepy FITS file, version 3.
    interpolation : {"linear", "spline"}
        Interpolation between the file's frequencies: linear in impedances and products of fields,
        as in luseepy, or cubic splines in impedances and fields.
    receiver : {"jfet", "capacitor", "file", "open"} or mapping, optional
        Receiver connected to the ports, with its parameters. Default: the receiver in the data file
        if it includes one, else luseepy's preamplifiers.
    antenna_temperature_k : float
        Temperature of the antennas, whose losses add thermal emission.
    """

    model: Literal["response"] = "response"
    receiver: ReceiverSection | None = None
    antenna_temperature_k: Temperature = 0.0

    def source(self) -> BeamSource:
        """The response of the file, with its receivers."""
        asked = self.asked() | {"antenna_k": self.antenna_temperature_k}
        if self.receiver is None:
            return replace(read_response(self.file), receiver_said=False, **asked)
        return replace(read_response(self.file), receiver=self.receiver.receiver(), **asked)


class SampledBeamSection(_FileSection):
    """Your own sampled beams: antenna fields or product beams by direction, or a UVBeam.

    Attributes
    ----------
    file : str
        netCDF or FITS from ``write_sampled_beams``, or a pyuvdata beam FITS.
    normalise : bool
        Scale the beams so that autos integrate to one on average; default: as in the file.
    """

    model: Literal["sampled"] = "sampled"
    normalise: bool | None = None

    def source(self) -> BeamSource:
        """The beams of the file."""
        asked = self.model_dump(exclude={"model", "file", "exact"})
        return replace(sampled.read_sampled(self.file), **asked)


class GridBeamSection(ScalarBeamSection, ResponseSection, SampledBeamSection):
    """Beams from files on a grid of parameters; each file uses the keys of its kind.

    Attributes
    ----------
    file : str
        CSV table of the files and their parameters.
    values : dict
        Values of the table's parameters; default: the middle of the grid.
    """

    has_parameters: ClassVar[bool] = True

    model: Literal["grid"] = "grid"
    values: dict[str, float] = Field(default_factory=dict)

    def source(self) -> BeamSource:
        """The beams of all files, interpolated."""
        return grid.read_beam_grid(self.file, self.values, lambda file: self.of_file(file).source())


BEAM_SECTIONS = kinds_of(
    MonopoleBeamSection, ScalarBeamSection, ResponseSection, SampledBeamSection, GridBeamSection
)


def _complete_beam(tree: dict[str, Any]) -> None:
    """Complete ``beam: {file: ...}`` without a model, as in older scenarios: the file decides."""
    file = tree.get("file")
    if (tree.get("model") or "monopole") == "monopole" and file is not None:
        tree["model"] = sampled.beam_kind(file) if isinstance(file, str) else "luseepy"
    if tree.get("model") not in ("response", "grid") and tree.get("receiver") == "jfet":
        del tree["receiver"]  # scenarios of version 0.1 contained the keys of all kinds


BeamSection = one_of(BEAM_SECTIONS, _complete_beam)
