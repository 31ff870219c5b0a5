"""What the times of samples are: starts, middles or ends of their windows, or instants.

Times and bounds that were rounded, such as single-precision seconds or Julian dates in one number,
make windows overlap by as much. Such overlaps are halved between the two samples, and a live time
that is longer than its window by as little is that of the window.
"""

from __future__ import annotations

from typing import Any, Literal

import astropy.units as u
import numpy as np
from astropy.time import Time
from jaxtyping import Float

from lusee_bayes.core.errors import InputError, nearest
from lusee_bayes.instrument.times import step_of, unannounced_leap_seconds, utc_times
from lusee_bayes.instrument.windows import Windows

Timestamp = Literal["start", "middle", "end", "instant"]
# from the time of a sample to the middle of its window, in lengths of the window
TO_MIDDLE = {"start": 0.5, "middle": 0.0, "end": -0.5}
# overlaps up to these are rounding of times: in seconds, and as a share of the step
ROUNDED_S, ROUNDED_SHARE = 1e-3, 1e-4


def stamped(
    times: Time,
    timestamp: str,
    step_s: float,
    live_s: Float[np.ndarray, " times"] | None = None,
) -> tuple[Time, Windows | None]:
    """Return the middles and the windows of samples that last for a step each.

    Parameters
    ----------
    times : (times,) Time
    timestamp : {"start", "middle", "end", "instant"}
        What they are.
    step_s : float
        Length of the windows, in seconds.
    live_s : (times,) array, optional
        What was integrated in them, in seconds; all of the time by default.

    Returns
    -------
    Time
        The middles; for instants the times as they are.
    Windows or None
        None for instants.

    Raises
    ------
    InputError
        For another timestamp, for instants with live times, and as :class:`.Windows`.
    """
    if timestamp == "instant":
        if live_s is not None:
            raise InputError(
                "instants have no live time; say whether the times are the start, middle or end "
                "of the samples, or leave out the live time"
            )
        return times, None
    if timestamp not in TO_MIDDLE:
        raise InputError(
            f"unknown timestamp '{timestamp}'; {nearest(timestamp, [*TO_MIDDLE, 'instant'])}"
        )
    with unannounced_leap_seconds():
        middles = times + TO_MIDDLE[timestamp] * step_s * u.s
        seconds = (times - times[0]).to_value(u.s)
    half = np.full(len(seconds), step_s / 2.0)
    return middles, _windows(seconds, -half, half, step_s, live_s)


def bounded(
    times: Time,
    bounds: Time,
    step_s: float | None = None,
    live_s: Float[np.ndarray, " times"] | None = None,
) -> tuple[Time, float, Windows]:
    """Return the middles, the step and the windows of samples whose start and end are known.

    Parameters
    ----------
    times : (times,) Time
        Anywhere within the samples.
    bounds : (times, 2) Time
        Start and end of each.
    step_s : float, optional
        In seconds; by default the median step from sample to sample.
    live_s : (times,) array, optional
        What was integrated, in seconds; all of the time by default.

    Raises
    ------
    InputError
        For a time outside its bounds, without a step for a single sample, and as
        :class:`.Windows`.
    """
    with unannounced_leap_seconds():
        start = (bounds[:, 0] - times).to_value(u.s)
        end = (bounds[:, 1] - times).to_value(u.s)
        middles = times + (start + end) / 2.0 * u.s
        seconds = (middles - middles[0]).to_value(u.s)
    length = end - start
    step = step_of(times, float(length[0]) if step_s is None and len(times) == 1 else step_s)
    rounding = _rounding(step)
    outside = (start > rounding) | (end < -rounding)
    backward = ~(length > 0.0)
    if (outside & ~backward).any():
        first = int(np.argmax(outside & ~backward))
        raise InputError(
            f"the time of sample {first} ({times[first].isot[:19]}) is not within its bounds, "
            f"which begin {start[first]:g} s and end {end[first]:g} s from it; give bounds in the "
            "order of the times"
        )
    if step_s is None and step < length.max() <= step + rounding:
        step = float(length.max())
    return middles, step, _windows(seconds, -length / 2.0, length / 2.0, step, live_s)


def utc_bounds(bounds: Any, n_times: int) -> Time:
    """Return bounds of any kind of times in UTC.

    Parameters
    ----------
    bounds : (times, 2) Time, or array of datetime, datetime64 or str

    Returns
    -------
    (times, 2) Time

    Raises
    ------
    InputError
        For another shape, and as :func:`.utc_times`.
    """
    bounds = bounds if isinstance(bounds, Time) else np.asarray(bounds)
    if bounds.shape != (n_times, 2):
        raise InputError(
            f"bounds have shape {bounds.shape}, expected ({n_times}, 2): start and end of every "
            "sample"
        )
    try:
        return utc_times(bounds).reshape(n_times, 2)
    except InputError as error:
        raise InputError(f"bounds, taken row by row: {error}") from error


def _rounding(step_s: float) -> float:
    return max(ROUNDED_S, ROUNDED_SHARE * step_s)


def _windows(
    seconds: Float[np.ndarray, " times"],
    start_s: Float[np.ndarray, " times"],
    end_s: Float[np.ndarray, " times"],
    step_s: float,
    live_s: Float[np.ndarray, " times"] | None,
) -> Windows:
    """Windows of one piece each, about ``seconds``, with overlaps by rounding cut off."""
    overlap = end_s[:-1] - start_s[1:] - np.diff(seconds)
    cut = np.where((overlap > 0.0) & (overlap <= _rounding(step_s)), overlap / 2.0, 0.0)
    start_s = start_s + np.append(0.0, cut)
    end_s = end_s - np.append(cut, 0.0)
    if live_s is not None:
        length = end_s - start_s
        rounded = (live_s > length) & (live_s <= length + _rounding(step_s))
        live_s = np.where(rounded, length, live_s)
    return Windows.whole(start_s, end_s, live_s)
