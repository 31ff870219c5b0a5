"""Where, when and with which turntable angles."""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from lusee_bayes.experiment.schema.section import Angle, Positive, Section
from lusee_bayes.instrument.moon import CYCLE_DAYS
from lusee_bayes.instrument.observation import Observation
from lusee_bayes.instrument.schedule import Interval, Run
from lusee_bayes.instrument.schedule_file import read_schedule
from lusee_bayes.instrument.timestamps import Timestamp


class RunSection(Section):
    """One stretch of data at one turntable angle.

    Attributes
    ----------
    cycles : float
        Length in lunar cycles of 27.321661 days.
    turntable_deg : float
        Angle of the turntable, from East towards North.
    night_only : bool
        Leave out samples with the Sun above the horizon.
    """

    cycles: Positive = 1.0
    turntable_deg: Angle = 0.0
    night_only: bool = False


class ObservationSection(Section):
    """Where and when; ``runs`` follow one another from ``start``, or a ``schedule`` has dates.

    Attributes
    ----------
    lon_deg : float
        Longitude of the site on the Moon (MCMF).
    lat_deg : float
        Latitude of the site on the Moon (MCMF).
    start : str
        Beginning of the first sample, UTC, as 2027-01-15T00:00:00.
    step_s : float
        Time between samples.
    window : {"mean", "instant"}
        What a sample is where no data say it: the mean over its step, or the sky at its beginning,
        as in the paper and in luseepy's simulators.
    timestamp : {"start", "middle", "end", "instant"}
        What the times of a file of data are, if it does not say so itself; windows then last for
        the file's step.
    average_s : float
        Data of a file are averaged over this time when they are read.
    runs : tuple of RunSection
        Stretches of data, one after another.
    schedule : str, optional
        File of the intervals in which data are taken, instead of ``start`` and ``runs``: CSV, or a
        command table of OpSim.
    fixed_axis : bool
        The Moon turns about the axis of the first sample, as luseepy's engine ``croissant`` has
        it; for data that it has made, with ``window: instant``.
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
        """Scenarios that were written with all entries, but without this one, had instants."""
        if isinstance(tree, Mapping) and "fixed_axis" in tree and "window" not in tree:
            return {**tree, "window": "instant"}
        return tree

    @model_validator(mode="after")
    def _a_fixed_axis_has_instants(self) -> ObservationSection:
        if self.fixed_axis and self.window != "instant":
            raise ValueError("fixed_axis is for samples that are instants; add window: instant")
        return self

    @model_validator(mode="after")
    def _a_schedule_has_all_dates(self) -> ObservationSection:
        if self.schedule is None:
            return self
        for name in ("start", "runs"):
            if getattr(self, name) != type(self).model_fields[name].default:
                raise ValueError(
                    f"schedule {self.schedule} says when data are taken, and so does {name}; leave "
                    "out one of them"
                )
        return self

    def observation(self) -> Observation:
        """Site, times and turntable angles."""
        return _observation(self, self._intervals())

    def n_samples(self) -> int:
        """Count the samples, those by day among them."""
        if self.schedule is None:
            return sum(int(run.cycles * CYCLE_DAYS * 86400.0 // self.step_s) for run in self.runs)
        return sum(interval.n_samples(self.step_s) for interval in self._intervals())

    def _intervals(self) -> tuple[Interval, ...]:
        return () if self.schedule is None else read_schedule(self.schedule)


@lru_cache(maxsize=2)
def _observation(section: ObservationSection, intervals: tuple[Interval, ...]) -> Observation:
    """One for all channels, with their times' orientations."""
    if intervals:
        return Observation.from_schedule(
            intervals,
            step_s=section.step_s,
            lon_deg=section.lon_deg,
            lat_deg=section.lat_deg,
            fixed_axis=section.fixed_axis,
            window=section.window,
        )
    return Observation.from_runs(
        tuple(Run(r.cycles, r.turntable_deg, r.night_only) for r in section.runs),
        start=section.start,
        step_s=section.step_s,
        lon_deg=section.lon_deg,
        lat_deg=section.lat_deg,
        fixed_axis=section.fixed_axis,
        window=section.window,
    )
