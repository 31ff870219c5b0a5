"""Stretches of observing and the samples that they are cut into.

Runs follow one another and are told by their length; the intervals of a schedule have dates, and
time may pass between them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Literal

import astropy.units as u
import numpy as np
from astropy.time import Time
from jaxtyping import Bool, Float, Int

from lusee_bayes.core.checks import require_positive
from lusee_bayes.core.errors import InputError
from lusee_bayes.instrument.moon import CYCLE_DAYS
from lusee_bayes.instrument.times import (
    require_ephemeris,
    unannounced_leap_seconds,
    utc_from_text,
)
from lusee_bayes.instrument.windows import ROUNDING_S, Windows


@dataclass(frozen=True)
class Run:
    """A stretch of data taken at one turntable angle.

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
        Fraction of the time in which the spectrometer integrates, spread evenly over the interval.
    night_only : bool
        Keep only the windows with the Sun below the horizon at their beginning, middle and end.
    where : str
        What messages call it, as the line of a file; by default its number in the schedule.

    Raises
    ------
    InputError
        For a bad date or number, and for an end that does not come after the start.
    """

    start: str
    end: str
    turntable_deg: float = 0.0
    duty_cycle: float = 1.0
    night_only: bool = False
    where: str = field(default="", compare=False)

    def __post_init__(self):
        place = f"{self.where}: " if self.where else ""
        if not self.length_s > ROUNDING_S:
            raise InputError(
                f"{place}end {self.end} does not come after start {self.start}; give the dates "
                "between which is observed"
            )
        if not np.isfinite(self.turntable_deg):
            raise InputError(
                f"{place}turntable_deg is {self.turntable_deg}; give an angle in degrees, positive "
                "from East towards North"
            )
        if not 0.0 < self.duty_cycle <= 1.0:
            raise InputError(
                f"{place}duty_cycle is {self.duty_cycle:g}; give the fraction of the time that is "
                "integrated, above 0 and up to 1, and leave out intervals in which nothing is"
            )

    @cached_property
    def start_time(self) -> Time:
        """The start, in UTC."""
        return self._date("start", self.start)

    @cached_property
    def length_s(self) -> float:
        """Length in seconds, the time without integration among them."""
        with unannounced_leap_seconds():
            return float((self._date("end", self.end) - self.start_time).to_value(u.s))

    def n_samples(self, step_s: float) -> int:
        """Count the samples of a step, by day and night; the last one may be shorter."""
        return max(1, int(np.ceil((self.length_s - ROUNDING_S) / step_s)))

    def _date(self, name: str, text: str) -> Time:
        # astropy knows no Z, which ISO has for UTC
        return utc_from_text(
            f"{self.where}: {name}" if self.where else name, text.removesuffix("Z")
        )


@dataclass(frozen=True)
class Cuts:
    """Stretches of observing, cut into samples.

    Attributes
    ----------
    t0 : Time
        Beginning of the first sample.
    start_s : (samples,) array
        Beginning of every sample, in seconds from ``t0``.
    length_s, live_s : (samples,) array
        How long it lasts, and what of that was integrated, in seconds.
    stretch : (samples,) array of int
        The run or interval that it lies in.
    run : (samples,) array of int
        The same, but one number for neighbours at the same turntable angle in a schedule.
    turntable_deg : (runs,) tuple of float
    night_only : (stretches,) tuple of bool
    names : (stretches,) tuple of str
        What messages call them.
    """

    t0: Time
    start_s: Float[np.ndarray, " samples"]
    length_s: Float[np.ndarray, " samples"]
    live_s: Float[np.ndarray, " samples"]
    stretch: Int[np.ndarray, " samples"]
    run: Int[np.ndarray, " samples"]
    turntable_deg: tuple[float, ...]
    night_only: tuple[bool, ...]
    names: tuple[str, ...]

    def samples(self, window: Literal["instant", "mean"]) -> tuple[Time, Windows | None]:
        """Return the times of the samples, and what they are the means of.

        Parameters
        ----------
        window : {"instant", "mean"}
            Whether a sample is the sky at its beginning, or the mean over its window, of which the
            middle is its time then.

        Returns
        -------
        times : (samples,) Time
            UTC.
        windows : Windows or None
            None for instants.

        Raises
        ------
        InputError
            For times outside the ephemeris, and for a duty cycle of instants.
        """
        seconds, windows = self.start_s, None
        require_ephemeris(np.array([self.t0.jd + seconds[-1] / 86400.0]))
        if window == "mean":
            half = self.length_s / 2.0
            seconds, windows = seconds + half, Windows.whole(-half, half, self.live_s)
        elif (self.live_s < self.length_s).any():
            raise InputError(
                "samples that are instants have no duty cycle; take windows "
                "(observation.window=mean), or leave out the schedule's duty_cycle"
            )
        with unannounced_leap_seconds():
            return self.t0 + seconds * u.s, windows

    def by_night(self, dark: Bool[np.ndarray, " samples"]) -> Bool[np.ndarray, " samples"]:
        """Return the samples that are left where nights alone are wanted.

        Parameters
        ----------
        dark : (samples,) array of bool
            Whether the Sun is down.

        Raises
        ------
        InputError
            If nothing is left of a run or interval.
        """
        keep = dark | ~np.array(self.night_only)[self.stretch]
        for number, name in enumerate(self.names):
            if not keep[self.stretch == number].any():
                raise InputError(
                    f"{name} holds no lunar night; lengthen it, move its start or drop night_only"
                )
        return keep


def cut_runs(runs: Sequence[Run], start: str, step_s: float) -> Cuts:
    """Cut runs that follow one another into whole steps; see :meth:`.Observation.from_runs`.

    Raises
    ------
    InputError
        For a bad date, step or length, for a run without samples, and if there is no run.
    """
    require_positive("step_s", step_s)
    if not runs:
        raise InputError("an observation needs at least one run, got none")
    t0 = utc_from_text("start", start)
    elapsed, starts, numbers = 0.0, [], []
    for number, run in enumerate(runs):
        require_positive(f"the length in cycles of run {number}", run.cycles)
        length = run.cycles * CYCLE_DAYS * 86400.0
        n = int(length // step_s)
        if n < 1:
            raise InputError(
                f"run {number} of {run.cycles} cycles holds no sample of {step_s} s; "
                "lengthen it or shorten step_s"
            )
        starts.append(elapsed + step_s * np.arange(n))
        numbers.append(np.full(n, number))
        elapsed += length
    stretch = np.concatenate(numbers)
    steps = np.full(len(stretch), float(step_s))
    return Cuts(
        t0,
        np.concatenate(starts),
        steps,
        steps,
        stretch,
        stretch,
        tuple(run.turntable_deg for run in runs),
        tuple(run.night_only for run in runs),
        tuple(f"run {number}" for number in range(len(runs))),
    )


def cut_intervals(intervals: Sequence[Interval], step_s: float) -> Cuts:
    """Cut every interval into steps from its start, of which the last may be shorter.

    Raises
    ------
    InputError
        For a bad step, and as :func:`require_sequence`.
    """
    require_positive("step_s", step_s)
    require_sequence(intervals)
    t0 = intervals[0].start_time
    starts, lengths, live, numbers = [], [], [], []
    for number, interval in enumerate(intervals):
        n = interval.n_samples(step_s)
        begins = step_s * np.arange(n)
        length = np.diff(begins, append=interval.length_s)
        starts.append(_seconds_between(t0, interval.start_time) + begins)
        lengths.append(length)
        live.append(interval.duty_cycle * length)
        numbers.append(np.full(n, number))
    given = np.array([interval.turntable_deg for interval in intervals])
    turned = np.append(True, np.diff(given) != 0.0)
    stretch = np.concatenate(numbers)
    return Cuts(
        t0,
        np.concatenate(starts),
        np.concatenate(lengths),
        np.concatenate(live),
        stretch,
        (np.cumsum(turned) - 1)[stretch],
        tuple(given[turned].tolist()),
        tuple(interval.night_only for interval in intervals),
        _names(intervals),
    )


def _names(intervals: Sequence[Interval]) -> tuple[str, ...]:
    """Where intervals are written, or their numbers."""
    return tuple(one.where or f"interval {number}" for number, one in enumerate(intervals))


def require_sequence(intervals: Sequence[Interval]) -> None:
    """Check that the intervals of a schedule come one after the other.

    Raises
    ------
    InputError
        If there is none, or if two are not in order or overlap.
    """
    if not intervals:
        raise InputError("a schedule needs at least one interval, got none")
    names = _names(intervals)
    for number, after in enumerate(intervals[1:]):
        before = intervals[number]
        ahead = _seconds_between(before.start_time, after.start_time)
        if ahead < 0.0:
            raise InputError(
                f"{names[number + 1]}: the interval from {after.start} begins before the one that "
                f"precedes it, from {before.start}; sort the intervals by their start"
            )
        overlap = before.length_s - ahead
        if overlap > ROUNDING_S:
            raise InputError(
                f"{names[number + 1]}: the interval from {after.start} begins {overlap:g} s before "
                f"the one that precedes it ends, {before.end}; give each stretch of time once"
            )


def _seconds_between(first: Time, second: Time) -> float:
    with unannounced_leap_seconds():
        return float((second - first).to_value(u.s))
