"""Times of observation: runs, the intervals of a schedule, and the samples cut from them.

Runs are consecutive and given by their length; the intervals of a schedule have dates, and gaps may
lie between them. Schedules are tables of intervals in CSV, or command tables of LuSEE-Night's
OpSim.

OpSim (https://github.com/lusee-night/opsim) stores schedules in YAML: ``config/comtable-*.yml``,
and the same with the states of battery and storage in its simulator's logs. An entry has a
``start`` (MJD, UTC) and a ``mode`` of the spacecraft, which lasts until the next entry starts. The
spectrometer takes data only in the mode ``science`` (``config/modes.yml`` and ``devices.yml``
there). Such a table has no turntable angles.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from io import StringIO
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from astropy.time import Time
from jaxtyping import Float

from lusee_bayes.core import checks, lazy
from lusee_bayes.core.errors import InputError, refusing
from lusee_bayes.core.reading import naming, parse_yaml, read_text, reading
from lusee_bayes.instrument import times

# a sidereal month
CYCLE_DAYS = 27.321661


@dataclass(frozen=True)
class Run:
    """A stretch of data at one turntable angle.

    Attributes
    ----------
    cycles : float
        Length in sidereal months of 27.321661 days.
    turntable_deg : float
        A positive angle turns the antennas from East towards North.
    night_only : bool
        Keep only the samples with the Sun below the horizon.
    """

    cycles: float = 1.0
    turntable_deg: float = 0.0
    night_only: bool = False


@dataclass(frozen=True)
class Interval:
    """A stretch of a schedule: observing from one date to another, at one turntable angle.

    Attributes
    ----------
    start, end : str
        UTC, ISO.
    turntable_deg : float
        A positive angle turns the antennas from East towards North.
    duty_cycle : float
        Fraction of the time spent integrating, spread evenly over the interval.
    night_only : bool
        Keep only the windows with the Sun below the horizon at their start, middle and end.
    where : str
        Name in messages, such as the line of a file; by default its number in the schedule.

    Raises
    ------
    InputError
        For a bad date or number, and for an end that is not after the start.
    """

    start: str
    end: str
    turntable_deg: float = 0.0
    duty_cycle: float = 1.0
    night_only: bool = False
    where: str = field(default="", compare=False)

    def __post_init__(self):
        if not self.length_s > times.ROUNDING_S:
            raise InputError(f"end {self.end} is not later than start {self.start}; exchange them")
        if not np.isfinite(self.turntable_deg):
            raise InputError(f"turntable_deg is {self.turntable_deg}; give an angle in degrees")
        if not 0.0 < self.duty_cycle <= 1.0:
            raise InputError(
                f"duty_cycle is {self.duty_cycle:g}; give the fraction integrated, above 0, up to 1"
            )

    @cached_property
    def start_time(self) -> Time:
        """The start, in UTC."""
        return times.time_of_text("start", self.start)

    @cached_property
    def length_s(self) -> float:
        """Length in seconds, including time without integration."""
        return float(times.seconds_from(self.start_time, times.time_of_text("end", self.end)))

    def n_samples(self, step_s: float) -> int:
        """Count the samples of ``step_s``, by day and night; the last one may be shorter."""
        return max(1, int(np.ceil((self.length_s - times.ROUNDING_S) / step_s)))


@dataclass(frozen=True)
class Cut:
    """A run or an interval, cut into samples.

    Attributes
    ----------
    samples_s : (3, samples) array
        Start of every sample, in seconds from the start of the first cut, its duration, and the
        time integrated in it.
    of : Run or Interval
    name : str
        Name in messages.
    """

    samples_s: Float[np.ndarray, "3 samples"]
    of: Run | Interval
    name: str


def cut_runs(runs: Sequence[Run], step_s: float) -> list[Cut]:
    """Cut consecutive runs into whole steps; see :meth:`.Observation.from_runs`.

    Raises
    ------
    InputError
        For a bad step or length, for a run without samples, and if there is no run.
    """
    checks.require_positive("step_s", step_s)
    if not runs:
        raise InputError("an observation needs at least one run, got none")
    elapsed, cuts = 0.0, []
    for number, run in enumerate(runs):
        checks.require_positive(f"the length in cycles of run {number}", run.cycles)
        length = run.cycles * CYCLE_DAYS * 86400.0
        if (n := int(length // step_s)) < 1:
            why = f"run {number} of {run.cycles} cycles has no sample of {step_s} s; shorten step_s"
            raise InputError(why)
        steps = np.full(n, float(step_s))
        samples = np.stack([elapsed + step_s * np.arange(n), steps, steps])
        cuts.append(Cut(samples, run, f"run {number}"))
        elapsed += length
    return cuts


def cut_intervals(intervals: Sequence[Interval], step_s: float) -> list[Cut]:
    """Cut every interval into steps from its start; the last step may be shorter.

    Raises
    ------
    InputError
        For a bad step, and as :func:`named_in_order`.
    """
    checks.require_positive("step_s", step_s)
    cuts = []
    for name, interval in named_in_order(intervals):
        begins = step_s * np.arange(interval.n_samples(step_s))
        length = np.diff(begins, append=interval.length_s)
        start = times.seconds_from(intervals[0].start_time, interval.start_time) + begins
        cuts.append(Cut(np.stack([start, length, interval.duty_cycle * length]), interval, name))
    return cuts


def named_in_order(intervals: Sequence[Interval]) -> list[tuple[str, Interval]]:
    """Return consecutive intervals, each with its name in messages.

    Raises
    ------
    InputError
        If there is none, or if two overlap or are out of order.
    """
    if not intervals:
        raise InputError("a schedule needs at least one interval, got none")
    named = [(one.where or f"interval {number}", one) for number, one in enumerate(intervals)]
    for (_, before), (name, after) in pairwise(named):
        if (ahead := times.seconds_from(before.start_time, after.start_time)) < 0.0:
            raise InputError(
                f"{name}: the interval from {after.start} begins before the previous one, from "
                f"{before.start}; sort the intervals by their start"
            )
        if (overlap := before.length_s - ahead) > times.ROUNDING_S:
            raise InputError(
                f"{name}: the interval from {after.start} begins {overlap:g} s before the previous "
                f"one ends, {before.end}; remove the overlap"
            )
    return named


WHAT = "a schedule, a table in CSV or OpSim's in YAML"
REQUIRED = {"start", "end", "turntable_deg"}
OPTIONAL = {"duty_cycle", "night_only"}
# OpSim's mode for taking data
OBSERVING = "science"


def read_schedule(path: str | Path) -> tuple[Interval, ...]:
    """Read the intervals of a schedule.

    Parameters
    ----------
    path : str or Path
        CSV with the columns ``start``, ``end`` (UTC, ISO) and ``turntable_deg``, and optionally
        ``duty_cycle`` and ``night_only`` (true or false); a # starts a comment. Or, if the name
        ends in .yaml or .yml, a command table of OpSim: its intervals in the mode ``science``, with
        the turntable at zero.

    Returns
    -------
    tuple of Interval
        In order of time.

    Raises
    ------
    InputError
        With file and row, for a missing column, a bad value, intervals that overlap or are out of
        order, and a schedule without intervals.
    """
    return _parsed(str(path), read_text(path, WHAT))


@lru_cache(maxsize=4)
def _parsed(path: str, text: str) -> tuple[Interval, ...]:
    """Parse a file once: several channels and estimates of their cost read it again."""
    is_yaml = Path(path).suffix in (".yaml", ".yml")
    intervals = _of_commands(path, text) if is_yaml else _of_table(path, text)
    with naming(path):
        named_in_order(intervals)
    return intervals


def _of_table(path: str, text: str) -> tuple[Interval, ...]:
    with reading(path, WHAT):
        table = lazy.pandas.read_csv(StringIO(text), dtype=str, comment="#", skipinitialspace=True)
        if not isinstance(table.index, lazy.pandas.RangeIndex):
            raise ValueError("rows have more entries than the header")
    table = table.fillna("")
    if not REQUIRED <= set(table.columns) <= REQUIRED | OPTIONAL:
        raise InputError(
            f"{path} has the columns {', '.join(table.columns)}; a schedule needs "
            f"{', '.join(sorted(REQUIRED))}, and may include {' and '.join(sorted(OPTIONAL))}"
        )
    rows = enumerate(table.to_dict("records"), start=1)
    return tuple(_interval(f"{path}, row {number}", row) for number, row in rows)


def _interval(place: str, row: dict[str, str]) -> Interval:
    with naming(place):
        options: dict[str, Any] = {"where": place}
        for name, default in (("turntable_deg", ""), ("duty_cycle", "1")):
            with refusing(f"{name} is '{row.get(name)}', expected a number", ValueError):
                options[name] = float(row.get(name) or default)
        night = (row.get("night_only", "").strip() or "false").lower()
        if night not in ("true", "false"):
            raise InputError(f"night_only is '{night}'; write true or false")
        return Interval(row["start"], row["end"], night_only=night == "true", **options)


def _of_commands(path: str, text: str) -> tuple[Interval, ...]:
    """Return every interval in the mode science."""
    root = parse_yaml(text, path)
    if not isinstance(root, dict):
        raise InputError(
            f"{path} is not a command table of OpSim: expected numbered entries with start and "
            "mode; for a table of intervals, use a CSV file with another ending"
        )
    entries = [_command(f"{path}, entry {name}", entry) for name, entry in root.items()]
    for (_, before, _), (place, after, _) in pairwise(entries):
        if not after > before:
            why = f"{place}: start {after} is not later than the previous one, {before}; sort them"
            raise InputError(why)
    if entries and entries[-1][2] == OBSERVING:
        why = f"{entries[-1][0]}: the last entry, {OBSERVING}, has no end; add one of another mode"
        raise InputError(why)
    return tuple(
        Interval(_date(start), _date(end), where=place)
        for (place, start, mode), (_, end, _) in pairwise(entries)
        if mode == OBSERVING
    )


def _command(place: str, entry: object) -> tuple[str, float, str]:
    """Return the place of an entry, its start as MJD and its mode."""
    expected = "a start (modified Julian date, UTC, e.g. 61050.8) and a mode in each entry"
    wrong = f"a command table of OpSim needs {expected}"
    with naming(place):
        with refusing(wrong, KeyError, TypeError, ValueError):
            start, mode = float(entry["start"]), str(entry["mode"])  # type: ignore[index]
        times.require_ephemeris(np.array([start + 2400000.5]))
    return place, start, mode


def _date(mjd: float) -> str:
    """Return the ISO date to the microsecond, the precision of an MJD in one double."""
    with times.unannounced_leap_seconds():
        return str(Time(mjd, format="mjd", scale="utc", precision=6).isot)
