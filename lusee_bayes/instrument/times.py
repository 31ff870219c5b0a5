"""Times of data: leap seconds, the ephemeris' reach, windows and the meaning of time stamps.

Times of any kind that files and users give are converted to UTC.

**Windows** are the periods over which samples were integrated: a visibility is the mean over its
window. A sample has one or more pieces, within each of which its live time is spread evenly: one
piece if the spectrometer integrated without a gap, or with a duty cycle far faster than the sky
turns; several if part of the time was left out. The mean over a window is the mean over its pieces,
weighted by live time.

The times of samples are starts, middles or ends of their windows, or instants. Rounded times and
bounds, such as single-precision seconds or Julian dates in one number, make windows overlap
slightly. Each such overlap is halved between the two samples, and a live time that exceeds its
window by as little is cut to the window.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any, Literal

import astropy.units as u
import erfa
import numpy as np
from astropy.time import Time
from jaxtyping import Bool, Float, Int

from lusee_bayes.core import checks, reading
from lusee_bayes.core.arrays import Times
from lusee_bayes.core.errors import InputError, nearest, refusing, require_known

Numbers, Nodes = Int[np.ndarray, " nodes"], Float[np.ndarray, " nodes"]
EPHEMERIS_YEARS = (1900, 2050)
EPHEMERIS_JD = [float(Time(f"{year}-01-01", scale="tdb").jd) for year in EPHEMERIS_YEARS]
# time scales that files may state
SCALES = ("utc", "tai", "tt", "tdb")


@contextmanager
def unannounced_leap_seconds() -> Iterator[None]:
    """Silence ERFA's warning that UTC of coming years may get more leap seconds."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", erfa.ErfaWarning)
        yield


def seconds_from(origin: Time, times: Time) -> Any:
    """Return the seconds from one time, or several, to others; leap seconds are counted."""
    with unannounced_leap_seconds():
        return (times - origin).to_value(u.s)


def later(times: Time, seconds: Any) -> Time:
    """Return the times ``seconds`` later."""
    with unannounced_leap_seconds():
        return times + seconds * u.s


def time_of_text(name: str, text: str | datetime | Time, scale: str = "utc") -> Time:
    """Return the time of an ISO date, or of another, in a time scale.

    Raises
    ------
    InputError
        If ``text`` is no date, or outside the ephemeris; the message begins with ``name``.
    """
    wrong = f"{name} '{text}' is not a date; write e.g. 2027-01-15T00:00:00"
    with refusing(wrong, ValueError, TypeError), unannounced_leap_seconds():
        # astropy does not accept ISO's Z for UTC
        iso = text.removesuffix("Z") if isinstance(text, str) else text
        time = getattr(Time(iso, scale=None if isinstance(iso, Time) else scale), scale)
    require_ephemeris(np.atleast_1d(time.jd))
    return time


def require_ephemeris(jd: Times) -> None:
    """Check that Julian dates lie within lunarsky's kernel of the Moon's orientation.

    Raises
    ------
    InputError
        If one does not.
    """
    first, last = EPHEMERIS_JD
    if not (outside := ~((jd >= first) & (jd <= last))).any():
        return
    at = float(jd[outside][0])
    date = f"Julian date {at:.6g}"
    if 0.0 < at < 5373484.0:  # years of four digits
        with unannounced_leap_seconds():
            date = Time(at, format="jd").isot[:19]
    wrong = f"{date} is outside the ephemeris, {EPHEMERIS_YEARS[0]} to {EPHEMERIS_YEARS[1]}"
    raise InputError(wrong)


def utc_of(jd1: Times, jd2: Times, scale: str = "utc") -> Time:
    """Return times in UTC from Julian dates in two parts.

    Raises
    ------
    InputError
        If one is not finite or outside the ephemeris.
    """
    require_ephemeris(jd1 + jd2)
    with unannounced_leap_seconds():
        return Time(jd1, jd2, format="jd", scale=scale).utc


def scale_of(name: str, stated: str) -> str:
    """Return the time scale that a file states as ``name``; InputError if it is unknown."""
    if (scale := stated.strip().lower()) not in SCALES:
        raise InputError(f"{name} is '{stated}'; {nearest(scale, SCALES)}")
    return scale


def utc_times(times: Any) -> Time:
    """Convert times of any kind to UTC.

    Parameters
    ----------
    times : (times,) Time, or sequence of datetime, datetime64 or str
        A datetime without time zone and an ISO date are in UTC.

    Raises
    ------
    InputError
        If they are not times, or outside the ephemeris.
    """
    if isinstance(times, Time):
        if times.masked or times.scale in ("ut1", "local"):
            kind = "masked" if times.masked else f"in {times.scale}"
            raise InputError(f"times are {kind}; give all of them, in {', '.join(SCALES)}")
        require_ephemeris(np.ravel(times.jd))
        with unannounced_leap_seconds():
            return times.reshape(-1).utc
    given = np.atleast_1d(np.asarray(times)).ravel()
    listed = np.datetime_as_string(given, unit="ns") if given.dtype.kind == "M" else given
    texts = [_as_text(number, one) for number, one in enumerate(listed.tolist())]
    with suppress(ValueError), unannounced_leap_seconds():
        parsed = Time(texts, scale="utc")
        require_ephemeris(parsed.jd)
        return parsed
    # dates of several formats, or an invalid one, which the message names
    return Time([time_of_text(f"time {k}", text) for k, text in enumerate(texts)])


def _as_text(number: int, one: Any) -> str:
    if isinstance(one, datetime):
        one = (one.astimezone(UTC).replace(tzinfo=None) if one.tzinfo else one).isoformat()
    if not isinstance(one, str):
        raise InputError(
            f"time {number} is {one!r}, a {type(one).__name__}; give datetimes, ISO dates or a Time"
        )
    # astropy does not accept ISO's Z for UTC
    return one.removesuffix("Z")


def step_of(times: Time, step_s: float | None) -> float:
    """Return the integration time in seconds: ``step_s``, or the median step of the times.

    Raises
    ------
    InputError
        If there is only one time, or most are equal, and no step is given.
    """
    if step_s is not None:
        return float(step_s)
    steps = np.abs(seconds_from(times[:-1], times[1:]))
    if len(times) < 2 or not (step := float(np.median(steps))) > 0.0:
        raise InputError("one time, or equal times, have no step: give step_s, and each time once")
    return step


def counts_up(numbers: Int[np.ndarray, " n"]) -> bool:
    """Return whether integers count 0, 1, ... without going back or skipping one."""
    return bool((numbers[:1] == 0).any() and np.isin(np.diff(numbers), (0, 1)).all())


# Julian dates in two parts are exact to less than a nanosecond, other times to a few
ROUNDING_S = 1e-6
# tolerance of times for people, which are written to the millisecond
EYE_S = 0.01


def require_same_times(what: str, off_s: Times, omitted: str) -> None:
    """Raise InputError if two statements on the same times differ by more than ``EYE_S``."""
    if (off_s > EYE_S).any():
        k = int(np.argmax(off_s > EYE_S))
        wrong = f"{what} of sample {k} differ by {off_s[k]:g} s; change both, or omit {omitted}"
        raise InputError(wrong)


@dataclass(frozen=True, repr=False)
class Windows(checks.Described):
    """Start, end and live time of every piece of every sample.

    Attributes
    ----------
    sample : (pieces,) array of int
        Sample number of each piece: 0, 1, ..., non-decreasing.
    start_s, end_s : (pieces,) array
        In seconds from the sample's time.
    live_s : (pieces,) array
        Time integrated between them, in seconds.

    Raises
    ------
    InputError
        For a piece that ends before it begins, overlaps the previous one, or was live for longer
        than it lasts or not at all, and for a sample without a piece.
    """

    sample: Int[np.ndarray, " pieces"]
    start_s: Float[np.ndarray, " pieces"]
    end_s: Float[np.ndarray, " pieces"]
    live_s: Float[np.ndarray, " pieces"]

    def __post_init__(self):
        checks.require_shape("sample of the windows", self.sample, (None,))
        if not counts_up(self.sample):
            why = "pieces of windows must count the samples 0, 1, ..., at least one piece for each"
            raise InputError(why)
        for name in ("start_s", "end_s", "live_s"):
            checks.require_shape(f"{name} of the windows", getattr(self, name), self.sample.shape)
            checks.require_finite(f"{name} of the windows", getattr(self, name))
        start, end, live = self.start_s, self.end_s, self.live_s
        early = (np.diff(self.sample) == 0) & (start[1:] < end[:-1] - ROUNDING_S)
        rules = (
            (end <= start, "ends {1:g} s from its time, not after its start at {0:g} s; windows "
             "need a start and then an end"),
            (live > end - start + ROUNDING_S, "was live for {2:g} s of a window of {3:g} s; live "
             "time cannot be longer than the window"),
            (live <= 0.0, "has a live time of {2:g} s; leave out samples in which nothing was "
             "integrated"),
            (np.append(False, early), "has a piece that begins at {0:g} s, before the one before "
             "it has ended; pieces of a window must not overlap"),
        )  # fmt: skip
        for wrong, text in rules:
            if wrong.any():
                k = int(np.argmax(wrong))
                text = text.format(start[k], end[k], live[k], end[k] - start[k])
                raise InputError(f"sample {self.sample[k]} {text}")

    @classmethod
    def whole(cls, start_s: Times, end_s: Times, live_s: Times | None = None) -> Windows:
        """Return windows of one piece each; ``live_s`` is by default their whole length."""
        live_s = end_s - start_s if live_s is None else live_s
        return cls(np.arange(len(start_s)), start_s, end_s, live_s)

    def description(self) -> tuple[str, ...]:
        live, bounds = self.live_per_sample_s, self.bounds_s
        share = live.sum() / (bounds[:, 1] - bounds[:, 0]).sum()
        pieces = f"{self.n_samples} windows in {len(self.sample)} pieces"
        return (f"{pieces}, live for {checks.extent(live, 's', 'g')}, {share:.1%} of the time",)

    @property
    def n_samples(self) -> int:
        """Number of samples."""
        return int(self.sample[-1]) + 1

    @property
    def live_per_sample_s(self) -> Float[np.ndarray, " samples"]:
        """Live time of every sample, in seconds."""
        return np.add.reduceat(self.live_s, self._first)

    @property
    def bounds_s(self) -> Float[np.ndarray, "samples 2"]:
        """Start and end of every sample, in seconds from its time."""
        last = np.append(self._first[1:], len(self.sample)) - 1
        return np.stack([self.start_s[self._first], self.end_s[last]], axis=1)

    @property
    def _first(self) -> Int[np.ndarray, " samples"]:
        return np.searchsorted(self.sample, np.arange(self.n_samples))

    def require_fitting(self, times: Time, step_s: float) -> None:
        """Check that windows match samples at these times, a step apart.

        Raises
        ------
        InputError
            If their number is not that of the times, and if one is longer than a step or overlaps
            the next.
        """
        if self.n_samples != len(times):
            raise InputError(f"windows of {self.n_samples} samples for {len(times)} times")
        bounds = self.bounds_s
        length = bounds[:, 1] - bounds[:, 0]
        if (length > step_s * (1.0 + 1e-9) + ROUNDING_S).any():
            longest = int(np.argmax(length))
            raise InputError(
                f"the window of sample {longest} lasts {length[longest]:g} s, longer than the step "
                f"between samples ({step_s:g} s); check the bounds, or give the step"
            )
        gaps = np.diff(seconds_from(times[0], times)) + bounds[1:, 0] - bounds[:-1, 1]
        if (gaps < -ROUNDING_S).any():
            first = int(np.argmax(gaps < -ROUNDING_S))
            raise InputError(
                f"the windows of samples {first} and {first + 1} ({times[first].isot[:19]}) "
                f"overlap by {-gaps[first]:g} s; give the length of the samples (step_s), or bounds"
            )

    def require_same(self, times: Time, bounds: Any = None, live_s: Any = None) -> None:
        """Check bounds and live times, as written for people, against the windows at these times.

        Raises
        ------
        InputError
            If they differ by more than a hundredth of a second.
        """
        if self.n_samples != len(times):
            return  # an Observation reports this
        if bounds is not None:
            seconds = seconds_from(times[:, None], utc_bounds(bounds, len(times)))
            off = np.abs(seconds - self.bounds_s).max(axis=1)
            require_same_times("time_bounds and the pieces", off, "the variables of the pieces")
        if live_s is not None:
            off = np.abs(live_s - self.live_per_sample_s)
            require_same_times("live_time and the pieces", off, "the variables of the pieces")

    def select(self, keep: Bool[np.ndarray, " samples"]) -> Windows:
        """Return the windows of the samples where ``keep`` is True."""
        kept = keep[self.sample]
        _, sample = np.unique(self.sample[kept], return_inverse=True)
        return Windows(sample, self.start_s[kept], self.end_s[kept], self.live_s[kept])

    def nodes(self, n: int) -> tuple[Numbers, Nodes, Nodes]:
        """Return instants whose weighted means equal those over the windows (Gauss-Legendre).

        Parameters
        ----------
        n : int
            Instants in each piece: exact for polynomials in time up to degree 2 n - 1.

        Returns
        -------
        sample : (nodes,) array of int
            Sample number of every instant, non-decreasing.
        offset_s : (nodes,) array
            Seconds from the sample's time, increasing within each sample.
        weight : (nodes,) array
            Weights that sum to 1 for each sample.
        """
        x, w = np.polynomial.legendre.leggauss(n)
        middle, half = (self.start_s + self.end_s) / 2.0, (self.end_s - self.start_s) / 2.0
        offset = middle[:, None] + half[:, None] * x
        share = self.live_s / self.live_per_sample_s[self.sample]
        return np.repeat(self.sample, n), offset.ravel(), (share[:, None] * (w / 2.0)).ravel()


Timestamp = Literal["start", "middle", "end", "instant"]
# from the time of a sample to the middle of its window, in lengths of the window
TO_MIDDLE = {"start": 0.5, "middle": 0.0, "end": -0.5}
# largest overlaps due to rounded times: in seconds, and as a share of the step
ROUNDED_S, ROUNDED_SHARE = 1e-3, 1e-4
# optional arguments: time from sample to sample, and the time integrated, in seconds
Step, Live = float | None, Times | None


def windows_of(
    times: Time, timestamp: str, step_s: Step = None, live_s: Live = None, bounds: Any = None
) -> tuple[Time, float, Windows | None]:
    """Return the middles, the step and the windows of samples.

    Parameters
    ----------
    times : (times,) Time
        Times of the samples; with bounds, anywhere within them.
    timestamp : {"start", "middle", "end", "instant"}
        Meaning of the times; without bounds each sample lasts for a step.
    step_s : float, optional
        Time from sample to sample, in seconds; by default the median.
    live_s : (times,) array, optional
        Time integrated in each sample, in seconds; by default all of it.
    bounds : (times, 2) array of any kind of times, optional
        Start and end of each sample.

    Returns
    -------
    Time
        The middles; for instants the unchanged times.
    float
        The step in seconds.
    Windows or None
        None for instants.

    Raises
    ------
    InputError
        For an unknown timestamp, for instants with live times or bounds, for a time outside its
        bounds, for a single sample without a step, and as :class:`.Windows`.
    """
    require_known("unknown timestamp", timestamp, [*TO_MIDDLE, "instant"])
    if timestamp == "instant":
        if live_s is not None or bounds is not None:
            what = "live time" if bounds is None else "bounds"
            raise InputError(f"instants have no {what}; omit it, or give another timestamp")
        return times, step_of(times, step_s), None
    if bounds is not None:
        start, end, step = _bounded(times, utc_bounds(bounds, len(times)), step_s)
    else:
        step, ones = step_of(times, step_s), np.ones(len(times))
        start, end = (step * (TO_MIDDLE[timestamp] + side) * ones for side in (-0.5, 0.5))
    middles, half = later(times, (start + end) / 2.0), (end - start) / 2.0
    return middles, step, contiguous(middles, half, step, live_s)


def contiguous(middles: Time, half: Times, step_s: float, live_s: Live = None) -> Windows:
    """Return windows of one piece, without the overlaps due to rounded times.

    Parameters
    ----------
    middles : (times,) Time
    half : (times,) array
        Half of the length of each window, in seconds.
    step_s : float
        Time from sample to sample, in seconds, with which the accepted overlap grows.
    live_s : (times,) array, optional
        Time integrated in each sample, in seconds; by default all of it.

    Raises
    ------
    InputError
        As :class:`.Windows`.
    """
    rounding = _rounding(step_s)
    overlap = half[:-1] + half[1:] - np.diff(seconds_from(middles[0], middles))
    cut = np.where((overlap > ROUNDING_S) & (overlap <= rounding), overlap / 2.0, 0.0)
    start, end = np.append(0.0, cut) - half, half - np.append(cut, 0.0)
    if live_s is not None:
        rounded = (live_s > end - start) & (live_s <= end - start + rounding)
        live_s = np.where(rounded, end - start, live_s)
    return Windows.whole(start, end, live_s)


def _bounded(times: Time, bounds: Time, step_s: float | None) -> tuple[Times, Times, float]:
    """Start and end of every sample, in seconds from its time, and the step."""
    start, end = (seconds_from(times, bounds[:, k]) for k in (0, 1))
    length = end - start
    step = step_of(times, float(length[0]) if step_s is None and len(times) == 1 else step_s)
    rounding = _rounding(step)
    if (outside := ((start > rounding) | (end < -rounding)) & (length > 0.0)).any():
        first = int(np.argmax(outside))
        raise InputError(
            f"the time of sample {first} ({times[first].isot[:19]}) is not within its bounds, "
            f"which begin {start[first]:g} s and end {end[first]:g} s from it; sort both alike"
        )
    if step_s is None:
        step = max(step, float(length.max()))
    return start, end, step


def utc_bounds(bounds: Any, n_times: int) -> Time:
    """Convert bounds, of any kind of times, to UTC.

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
        raise InputError(f"bounds have shape {bounds.shape}, expected ({n_times}, 2)")
    with reading.naming("bounds, row by row"):
        return utc_times(bounds).reshape(n_times, 2)


def _rounding(step_s: float) -> float:
    return max(ROUNDED_S, ROUNDED_SHARE * step_s)
