"""The mission clock: the UTC of its seconds.

A file of luseepy's layout 3 defines it by ``mjd_epoch_offset_days``, ``raw_time_subtract_seconds``
and ``time_scale``, which may be "unknown"; one of layout 4 by a clock reference, or not at all. A
clock file defines it from outside: luseepy's clock reference, format 1, in JSON, ::

    {"format_version": 1, "reference_event": "landing",
     "clock_reference_isot": "2027-01-10T00:00:00", "time_scale": "utc",
     "clocks": {"spectrometer": {"clock_reference_raw_seconds": 123.0}},
     "source": "mission timing record", "assumed": false}

with an optional ``rate``, the seconds of ``time_scale`` in a second of the clock: 1 by default,
above 1 for a clock that runs slow. With ``stated_utc_isot`` in place of ``clocks`` the file
corrects the UTC of sessions: ``stated_utc_isot`` was in truth ``clock_reference_isot``, and
``rate`` is the seconds of ``time_scale`` in a second of the sessions' UTC.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from astropy.time import Time
from pydantic import Field

from lusee_bayes.core import reading, section
from lusee_bayes.core.arrays import Times
from lusee_bayes.core.errors import InputError
from lusee_bayes.instrument import times

DAY_S, MJD_ZERO = 86400.0, 2400000.5
# clocks that differ by less are equal
SAME_S = 1e-3
# largest error of a clock's rate
MOST_OFF = 1e-2


class _Reading(section.Section):
    clock_reference_raw_seconds: float


class _Clocks(section.Section):
    """Readings of the clocks in luseepy's records at ``clock_reference_isot``."""

    spectrometer: _Reading
    dcb: _Reading | None = None


class _ClockFile(section.Section):
    """Contents of a clock file."""

    format_version: Literal[1]
    clock_reference_isot: str
    time_scale: str
    source: str
    rate: Annotated[float, Field(ge=1.0 - MOST_OFF, le=1.0 + MOST_OFF)] = 1.0
    stated_utc_isot: str | None = None
    clocks: _Clocks | None = None
    reference_event: Any = None
    assumed: Any = None
    source_sha256: Any = None


@dataclass(frozen=True)
class Clock:
    """A mission clock.

    Attributes
    ----------
    source : str
        Origin of the clock, for messages.
    jd1, jd2 : float
        A time, as a Julian date in two parts.
    scale : str
        Scale of this time: utc, tai, tt or tdb.
    raw_s : float
        Reading of the clock at this time.
    rate : float
        Seconds of ``scale`` in a second of the clock.
    stated : Time or None
        For a clock that corrects sessions: the UTC that they state at this time; ``raw_s`` is then
        ignored.
    """

    source: str
    jd1: float
    jd2: float
    scale: str
    raw_s: float
    rate: float = 1.0
    stated: Time | None = None

    def utc(self, raw_s: Times) -> Time:
        """Return UTC for readings of the clock.

        Parameters
        ----------
        raw_s : (times,) array
            Readings, in seconds.

        Raises
        ------
        InputError
            If a time is outside the ephemeris.
        """
        days = self.rate * (raw_s - self.raw_s) / DAY_S
        whole = np.floor(days)
        return times.utc_of(self.jd1 + whole, self.jd2 + (days - whole), self.scale)

    @property
    def isot(self) -> str:
        """The reference time as text, in its own scale."""
        with times.unannounced_leap_seconds():
            return str(Time(self.jd1, self.jd2, format="jd", scale=self.scale, precision=9).isot)

    def differs_s(self, other: Clock, raw_s: Times) -> float:
        """Return the largest difference between two clocks over these readings, in seconds."""
        ends = np.array([raw_s.min(), raw_s.max()])
        return float(np.abs(times.seconds_from(other.utc(ends), self.utc(ends))).max())


def read_clock(path: str | Path) -> Clock:
    """Read a clock file.

    Parameters
    ----------
    path : str or Path

    Raises
    ------
    InputError
        If it cannot be read, lacks an entry, has an unknown entry, or an invalid date or scale.
    """
    hint = "write luseepy's clock reference (format_version 1), see docs/howto/first_light.md"
    file = reading.read_model(path, _ClockFile, "a clock reference", hint)
    if (file.stated_utc_isot is None) == (file.clocks is None):
        raise InputError(
            f"{path} needs either clocks, for sessions whose UTC is unknown, or stated_utc_isot, "
            "to correct the UTC stated in sessions; see docs/howto/first_light.md"
        )
    with reading.naming(path):
        scale = times.scale_of("time_scale", file.time_scale)
        time = times.time_of_text("clock_reference_isot", file.clock_reference_isot, scale)
        clock = Clock(str(path), float(time.jd1), float(time.jd2), scale, 0.0, file.rate)
        if file.clocks is None:
            stated = times.time_of_text("stated_utc_isot", file.stated_utc_isot)
            return replace(clock, stated=stated)
        return replace(clock, raw_s=file.clocks.spectrometer.clock_reference_raw_seconds)


def clock_of(path: str | Path, said: Clock | None, given: Clock | None, raw_s: Times) -> Clock:
    """Return the clock of a session: its own, a clock file's, or its own as corrected by the file.

    A clock file that does not correct the session's clock must not contradict it.

    Parameters
    ----------
    path : str or Path
        The session's file.
    said, given : Clock or None
        The session's own clock, and that of the user's clock file.
    raw_s : (times,) array
        The session's readings.

    Raises
    ------
    InputError
        If neither clock is given, if they differ by more than a millisecond, or if there is nothing
        to correct.
    """
    if given is None and said is None:
        raise InputError(
            f"{path} does not specify the UTC of its clock (its time scale is unknown), and a "
            "wrong scale or epoch rotates the map; give --clock clock.json (epoch, scale, rate)"
        )
    if given is not None and given.stated is not None:
        if said is None:
            wrong = f"{path} contains no UTC of {given.source}: give clocks, not stated_utc_isot"
            raise InputError(wrong)
        since_s = float(times.seconds_from(said.utc(np.array([said.raw_s]))[0], given.stated))
        raw_s = said.raw_s + since_s / said.rate
        return replace(given, raw_s=raw_s, rate=given.rate * said.rate, stated=None)
    if given is None or said is None:
        return said or given
    if (differ := given.differs_s(said, raw_s)) > SAME_S:
        raise InputError(
            f"{path} and {given.source} differ by {differ:.6g} s on the clock: the session has "
            f"{said.scale.upper()}, the clock file {given.scale.upper()}; omit --clock, or give a "
            "file with stated_utc_isot, which corrects the session's"
        )
    return given
