"""Times in UTC, of whatever kind files and users give them."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from functools import lru_cache
from typing import Any

import astropy.units as u
import erfa
import numpy as np
from astropy.time import Time
from jaxtyping import Float, Shaped

from lusee_bayes.core.errors import InputError, nearest
from lusee_bayes.core.layouts import Attribute, Content

EPHEMERIS_YEARS = (1900, 2050)
# scales of time that files may state
SCALES = ("utc", "tai", "tt", "tdb")
# what a file of Julian dates in two parts, jd1 and jd2, may state of them
JD_SCALES = {name: Attribute("text", optional=True) for name in ("jd1.scale", "jd2.scale")}
EPOCH, CENTURIES = np.datetime64("2000-01-01"), np.timedelta64(100_000, "D")


@contextmanager
def unannounced_leap_seconds() -> Iterator[None]:
    """Silence ERFA's warning that UTC of coming years may get more leap seconds."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", erfa.ErfaWarning)
        yield


def utc_from_text(name: str, text: str) -> Time:
    """Return the time of an ISO date in UTC.

    Raises
    ------
    InputError
        If it is none, or outside the ephemeris; the message begins with ``name``.
    """
    try:
        with unannounced_leap_seconds():
            time = Time(text, scale="utc")
    except (ValueError, TypeError) as error:
        raise InputError(
            f"{name} '{text}' is not a date; write it as 2027-01-15T00:00:00"
        ) from error
    require_ephemeris(np.atleast_1d(time.jd))
    return time


def require_ephemeris(jd: Float[np.ndarray, " times"]) -> None:
    """Check that Julian dates lie within lunarsky's kernel of the Moon's orientation.

    Raises
    ------
    InputError
        If one does not.
    """
    first, last = _ephemeris_jd()
    outside = ~((jd >= first) & (jd <= last))
    if not outside.any():
        return
    at = float(jd[outside][0])
    date = f"Julian date {at:.6g}"
    if 0.0 < at < 5373484.0:  # years of four digits
        with unannounced_leap_seconds():
            date = Time(at, format="jd").isot[:19]
    raise InputError(
        f"sample times run outside the ephemeris ({EPHEMERIS_YEARS[0]}-{EPHEMERIS_YEARS[1]}): "
        f"{date}; give a start inside it"
    )


@lru_cache(maxsize=1)
def _ephemeris_jd() -> tuple[float, ...]:
    return tuple(float(Time(f"{year}-01-01", scale="tdb").jd) for year in EPHEMERIS_YEARS)


def utc_of(
    jd1: Float[np.ndarray, " times"], jd2: Float[np.ndarray, " times"], scale: str = "utc"
) -> Time:
    """Return times of Julian dates in two parts, in UTC.

    Raises
    ------
    InputError
        If one is not finite or outside the ephemeris.
    """
    require_ephemeris(jd1 + jd2)
    with unannounced_leap_seconds():
        return Time(jd1, jd2, format="jd", scale=scale).utc


def scale_of(name: str, stated: str) -> str:
    """Return a scale of time that a file states as ``name``. InputError if it is not known."""
    scale = stated.strip().lower()
    if scale not in SCALES:
        raise InputError(f"{name} is '{stated}'; {nearest(scale, SCALES)}")
    return scale


def utc_of_jd(found: Content) -> Time:
    """Return times of a file's ``jd1`` and ``jd2``, in UTC.

    They are in the scale that the file states (:data:`JD_SCALES`), or in UTC.

    Raises
    ------
    InputError
        If the scale is not known or differs between the two, and as :func:`utc_of`.
    """
    scales = {scale_of(n, found.values[n]) for n in JD_SCALES if n in found.values} or {"utc"}
    if len(scales) > 1:
        raise InputError(f"jd1 and jd2 have different scales, {' and '.join(sorted(scales))}")
    return utc_of(found.arrays["jd1"], found.arrays["jd2"], scales.pop())


def utc_of_datetimes(times: Shaped[np.ndarray, "*shape"]) -> Time:
    """Return times of an array of datetime64 in UTC, all at once.

    Raises
    ------
    InputError
        If one is outside the ephemeris.
    """
    with unannounced_leap_seconds():
        found = Time(times, format="datetime64", scale="utc")
    require_ephemeris(np.ravel(found.jd))
    return found


def utc_times(times: Any) -> Time:
    """Return times of any kind in UTC.

    Parameters
    ----------
    times : (times,) Time, or sequence of datetime, datetime64 or str
        A datetime without zone and an ISO date are in UTC.

    Raises
    ------
    InputError
        If they are none, or outside the ephemeris.
    """
    if not isinstance(times, Time):
        given = np.atleast_1d(np.asarray(times)).ravel()
        if given.dtype.kind == "M":
            if (np.abs(given - EPOCH) < CENTURIES).all():
                return utc_of_datetimes(given)
            # what is no date, or so far away that astropy cannot read it, is named by what follows
            given = np.datetime_as_string(given)
        listed = given.tolist()
        return Time([_utc(number, one) for number, one in enumerate(listed)])
    times = times.reshape(-1)
    require_ephemeris(np.asarray(times.jd))
    with unannounced_leap_seconds():
        return times.utc


def _utc(number: int, one: Any) -> Time:
    if isinstance(one, datetime):
        one = one.astimezone(UTC).replace(tzinfo=None) if one.tzinfo else one
        one = one.isoformat()
    if not isinstance(one, str):
        raise InputError(
            f"time {number} is {one!r}, of type {type(one).__name__}; give datetimes, ISO dates in "
            "UTC, or an astropy Time"
        )
    # astropy knows no Z, which ISO has for UTC
    return utc_from_text(f"time {number}", one.removesuffix("Z"))


def step_of(times: Time, step_s: float | None) -> float:
    """Return the integration time in seconds: the one given, or the median step of the times.

    Raises
    ------
    InputError
        If there is one time only, and no step is given.
    """
    if step_s is not None:
        return float(step_s)
    if len(times) < 2:
        raise InputError("the integration time of a single sample is not known; give step_s")
    with unannounced_leap_seconds():
        return float(np.median(np.abs((times[1:] - times[:-1]).to_value(u.s))))
