"""Where luseepy's ranges of time begin: the word LUNAR_DAY of its waterfalls.

It is "UTC to UTC"; a calendar year, CY2026 or CY26, which luseepy begins at one o'clock on the
first of January; a fiscal year, FY2026 or FY26, from the first of October of the year before; or
the number of a lunar day: 2603 is the fourth of those that begin in 2026. A lunar day begins when
the Sun is highest at 180 degrees of longitude on the Moon's equator. luseepy finds that to a few
seconds, and so does this module.
"""

from __future__ import annotations

import re

import numpy as np
from astropy.time import Time
from jaxtyping import Float

from lusee_bayes.core.errors import InputError
from lusee_bayes.instrument.ephemeris import body_direction
from lusee_bayes.instrument.observation import Observation
from lusee_bayes.instrument.times import utc_from_text, utc_of

YEAR = re.compile(r"(CY|FY)([0-9]{2}|[0-9]{4})")
LUNAR_DAY = re.compile(r"[0-9]{3,4}")
# luseepy looks for noons day by day until the end of January of the next year
DAYS_AFTER_NEW_YEAR = 30
# each round finds the noon to a twentieth: after four, a day has become half a second
ROUNDS, POINTS = 4, 41


def start_of(text: str) -> Time:
    """Return the first time of a range, in UTC.

    Parameters
    ----------
    text : str
        LUNAR_DAY.

    Raises
    ------
    InputError
        If the range is of no known kind, or outside the ephemeris.
    """
    word = text.strip()
    if named := YEAR.fullmatch(word):
        kind, year = named[1], int(named[2])
        year += 2000 if year < 100 else 0
        return utc_from_text(
            "LUNAR_DAY", f"{year:04d}-01-01T01:00" if kind == "CY" else f"{year - 1:04d}-10-01"
        )
    if LUNAR_DAY.fullmatch(word):
        return _noon(int(word))
    first, to, _ = word.partition(" to ")
    if not to:
        raise InputError(
            f"LUNAR_DAY '{text}' is not a date to a date (2027-01-15 00:00:00 to 2027-02-01), a "
            "year (CY2027, FY27) or the number of a lunar day (2700)"
        )
    return utc_from_text("LUNAR_DAY", first)


def _noon(number: int) -> Time:
    year, place = 2000 + number // 100, number % 100
    new_year, next_year = (utc_from_text("LUNAR_DAY", f"{y}-01-01").jd for y in (year, year + 1))
    days = np.arange(new_year, next_year + DAYS_AFTER_NEW_YEAR)
    height = _sun_height(days)
    highest = (height[1:-1] > height[:-2]) & (height[1:-1] > height[2:])
    # a lunar day needs an end, too
    beginning = days[1:-1][highest][:-1]
    noon = _refined(beginning[place]) if place < len(beginning) else np.inf
    if noon >= next_year:
        raise InputError(
            f"LUNAR_DAY {number}: expected a number from {number - place}, the first lunar day of "
            f"{year}; 12 or 13 of them begin in a year"
        )
    return utc_of(np.array([noon]), np.zeros(1))[0]


def _refined(jd: float) -> float:
    """The time when the Sun is highest, within a day."""
    span = 1.0
    for _ in range(ROUNDS):
        around = jd + np.linspace(-span, span, POINTS)
        jd, span = float(around[np.argmax(_sun_height(around))]), span * 2.0 / (POINTS - 1)
    return jd


def _sun_height(jd: Float[np.ndarray, " times"]) -> Float[np.ndarray, " times"]:
    """Sine of the Sun's altitude in the middle of the far side."""
    zeros = np.zeros(len(jd), dtype=int)
    there = Observation(180.0, 0.0, utc_of(jd, np.zeros(len(jd))), zeros, (0.0,), 1.0)
    return np.einsum("ti,ti->t", body_direction("Sun", there), there.zenith_galactic())
