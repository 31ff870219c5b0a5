"""The mission clock: which UTC its seconds stand for.

A file of luseepy's layout 3 says it by ``mjd_epoch_offset_days``, ``raw_time_subtract_seconds`` and
``time_scale``, which may be "unknown"; one of layout 4 by a clock reference, or not at all. A clock
file says it from outside: luseepy's clock reference, format 1, which is JSON, ::

    {"format_version": 1, "reference_event": "landing",
     "clock_reference_isot": "2027-01-10T00:00:00", "time_scale": "utc",
     "clocks": {"spectrometer": {"clock_reference_raw_seconds": 123.0}},
     "source": "mission timing record", "assumed": false}

with ``rate``, the seconds of ``time_scale`` in a second of the clock, where it is not 1.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from astropy.time import Time
from jaxtyping import Float

from lusee_bayes.core.errors import InputError, nearest
from lusee_bayes.core.layouts import Attribute, Layout
from lusee_bayes.core.reading import read_json
from lusee_bayes.instrument.times import unannounced_leap_seconds, utc_of

SCALES = ("utc", "tai", "tt", "tdb")
DAY_S = 86400.0
# two clocks that differ by less are one
SAME_S = 1e-3
# a clock that is off by more is none
MOST_OFF = 1e-2
FORMAT = Layout(
    "a clock reference",
    attributes={
        "format_version": Attribute("integer", low=1.0, high=1.0),
        "clock_reference_isot": Attribute("text"),
        "time_scale": Attribute("text"),
        "source": Attribute("text"),
        "rate": Attribute(low=1.0 - MOST_OFF, high=1.0 + MOST_OFF, optional=True),
    },
)
KEYS = {
    *FORMAT.attributes,
    "reference_event",
    "clocks",
    "assumed",
    "source_sha256",
}
ISO = re.compile(r"\d{4}-\d{2}-\d{2}T\d{2}:\d{2}:\d{2}(\.\d+)?")


@dataclass(frozen=True)
class Clock:
    """A mission clock.

    Attributes
    ----------
    source : str
        Who says so, for messages.
    jd1, jd2 : float
        A time, as a Julian date in two parts.
    scale : str
        Of this time: utc, tai, tt or tdb.
    raw_s : float
        What the clock shows then.
    rate : float
        Seconds of ``scale`` in a second of the clock.
    """

    source: str
    jd1: float
    jd2: float
    scale: str
    raw_s: float
    rate: float = 1.0

    def utc(self, raw_s: Float[np.ndarray, " times"]) -> Time:
        """Return UTC at readings of the clock.

        Parameters
        ----------
        raw_s : (times,) array
            In seconds.

        Raises
        ------
        InputError
            If one is outside the ephemeris.
        """
        days = self.rate * (raw_s - self.raw_s) / DAY_S
        whole = np.floor(days)
        return utc_of(self.jd1 + whole, self.jd2 + (days - whole), self.scale)

    def differs_s(self, other: Clock, raw_s: Float[np.ndarray, " times"]) -> float:
        """Return by how many seconds two clocks differ at most at some readings."""
        ends = np.array([raw_s.min(), raw_s.max()])
        with unannounced_leap_seconds():
            return float(np.abs((self.utc(ends) - other.utc(ends)).sec).max())


def read_clock(path: str | Path) -> Clock:
    """Read a clock file.

    Parameters
    ----------
    path : str or Path

    Raises
    ------
    InputError
        If it cannot be read, lacks something, has an entry that is not known, or a date or scale
        that is none.
    """
    hint = "write luseepy's clock reference (format_version 1), see docs/howto/first_light.md"
    found = read_json(path, FORMAT, hint)
    for key in found:
        if key not in KEYS:
            raise InputError(f"{path}: unknown entry '{key}'; {nearest(key, KEYS)}")
    scale = found["time_scale"].lower()
    if scale not in SCALES:
        raise InputError(
            f"{path}: time_scale is '{found['time_scale']}'; expected one of {', '.join(SCALES)}"
        )
    text = found["clock_reference_isot"]
    if not ISO.fullmatch(text):
        raise InputError(f"{path}: clock_reference_isot '{text}' is no date as 2027-01-15T00:00:00")
    try:
        with unannounced_leap_seconds():
            time = Time(text, format="isot", scale=scale)
    except ValueError as error:
        raise InputError(f"{path}: clock_reference_isot '{text}' is no date: {error}") from error
    clocks = found.get("clocks")
    spectrometer = clocks.get("spectrometer") if isinstance(clocks, dict) else None
    raw_s = (
        spectrometer.get("clock_reference_raw_seconds") if isinstance(spectrometer, dict) else None
    )
    if isinstance(raw_s, bool) or not isinstance(raw_s, int | float) or not np.isfinite(raw_s):
        raise InputError(
            f"{path} has no clocks.spectrometer.clock_reference_raw_seconds that is a number: what "
            "the spectrometer's clock showed at clock_reference_isot"
        )
    rate = float(found.get("rate", 1.0))
    return Clock(str(path), float(time.jd1), float(time.jd2), scale, float(raw_s), rate)


def clock_of(
    path: str | Path,
    said: Clock | None,
    given: Clock | None,
    raw_s: Float[np.ndarray, " times"],
) -> Clock:
    """Return the clock that a file or a clock file says; they must not contradict each other.

    Parameters
    ----------
    path : str or Path
        Of the session.
    said, given : Clock or None
        By the session itself, and by the user's clock file.
    raw_s : (times,) array
        The session's readings.

    Raises
    ------
    InputError
        If neither says it, or both do and differ by more than a millisecond.
    """
    if given is None and said is None:
        raise InputError(
            f"{path} does not say which UTC its clock stands for (its time scale is unknown), and "
            "a wrong scale or epoch turns the map; give --clock clock.json (epoch, scale, rate)"
        )
    if given is None or said is None:
        return said or given
    differ = given.differs_s(said, raw_s)
    if differ > SAME_S:
        raise InputError(
            f"{path} and {given.source} differ by {differ:.6g} s about the clock: the session says "
            f"{said.scale.upper()}, the clock file {given.scale.upper()}; leave out --clock, or "
            "correct the one that is wrong"
        )
    return given
