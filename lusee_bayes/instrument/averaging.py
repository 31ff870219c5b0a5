"""Means of data over longer times.

A is exact for a mean if all products of a sample have the same window. In each bin:

1. samples in which every product is flagged are left out;
2. a product that is present for less than half of the live time of the others is left out: it is
   flagged in the bin;
3. samples that lack one of the other products are left out.

Of the samples that remain, the value of the bin is the mean, each with the weight of its live time,
and their windows are that of the bin. Bins of which nothing remains are dropped.
"""

from __future__ import annotations

from dataclasses import replace

import astropy.units as u
import numpy as np
from jaxtyping import Bool, Float, Int

from lusee_bayes.core.checks import require_positive
from lusee_bayes.core.errors import InputError
from lusee_bayes.instrument.layout import DataLayout
from lusee_bayes.instrument.observation import Observation
from lusee_bayes.instrument.times import unannounced_leap_seconds
from lusee_bayes.instrument.visibilities import Visibilities
from lusee_bayes.instrument.windows import ROUNDING_S, Windows

# the sky turns once in 27 days: a longer mean is a slip, of units for instance
LONGEST_S = 30.0 * 86400.0
# a product that is present for less of a bin's live time is left out of the bin
LEAST_SHARE = 0.5


def averaged(data: Visibilities, to_s: float) -> Visibilities:
    """Average data over bins of a given length.

    Bins begin at the start of the first window of each run, and end with the run. Where samples do
    not fit into them, after a gap or because the length is no multiple of theirs, a bin ends before
    the sample that would make it longer than ``to_s``.

    Parameters
    ----------
    data : Visibilities
        Of samples with windows.
    to_s : float
        Length of the bins, in seconds; the step of what is returned.

    Returns
    -------
    Visibilities
        Times are the middles between start and end of each bin.

    Raises
    ------
    InputError
        For instants, for bins that are shorter than the samples or longer than 30 days, and if
        nothing is left.
    """
    require_positive("the time to average over, in seconds,", to_s)
    observation = data.observation
    windows = observation.windows
    if windows is None:
        raise InputError(
            "the samples are instants, which have no mean over a time; average samples with "
            "windows (observation.window=mean in a simulation, observation.timestamp for data "
            "whose file does not say what its times are)"
        )
    if to_s < observation.step_s - ROUNDING_S:
        raise InputError(
            f"the data are to be averaged over {to_s:g} s, which is shorter than their samples of "
            f"{observation.step_s:g} s; give at least that, or leave them as they are"
        )
    live_s = windows.live_per_sample_s
    bin_of = bins_of(observation, windows.bounds_s, to_s)
    kept, used = by_the_rule(np.asarray(data.layout.present), bin_of, live_s)
    left = np.flatnonzero(used)
    if not left.size:
        raise InputError(
            f"nothing is left of the data in bins of {to_s:g} s: in none of them do the products "
            "have samples in common; average over less"
        )
    # bins of which something remains, counted anew
    bins, bin_of_left = np.unique(bin_of[left], return_inverse=True)
    weight = live_s[left] / np.bincount(bin_of_left, live_s[left])[bin_of_left]
    grid = np.asarray(data.layout.scatter(data.data))[:, left] * weight
    first = np.searchsorted(bin_of_left, np.arange(len(bins)))
    layout = DataLayout.from_flags(~kept[:, bins])
    return replace(
        data,
        data=layout.gather(np.add.reduceat(grid, first, axis=1)),
        layout=layout,
        observation=binned(observation, left, bin_of_left, to_s),
    )


def product_live_s(data: Visibilities) -> float:
    """Return the live time of data in seconds, that of every product counted."""
    return float(data.observation.live_s[data.layout.time].sum())


def bins_of(
    observation: Observation, bounds_s: Float[np.ndarray, "times 2"], to_s: float
) -> Int[np.ndarray, " times"]:
    """Return the number of the bin of every sample.

    Parameters
    ----------
    observation : Observation
    bounds_s : (times, 2) array
        Start and end of every sample, in seconds from its time.
    to_s : float
        Length of the bins, in seconds.

    Raises
    ------
    InputError
        For bins of more than 30 days.
    """
    if to_s > LONGEST_S:
        raise InputError(
            f"the data are to be averaged over {to_s:g} s, {to_s / 86400.0:g} days; give at most "
            f"{LONGEST_S / 86400.0:g} days, in which the Moon turns once"
        )
    seconds = _seconds(observation)
    start, end = seconds + bounds_s[:, 0], seconds + bounds_s[:, 1]
    origin = start[np.searchsorted(observation.run, observation.run)]
    place = np.floor((start - origin + ROUNDING_S) / to_s)
    bin_of = np.zeros(len(start), dtype=np.int64)
    begins = 0
    for k in range(1, len(start)):
        same = observation.run[k] == observation.run[begins] and place[k] == place[begins]
        if same and end[k] - start[begins] <= to_s + ROUNDING_S:
            bin_of[k] = bin_of[k - 1]
        else:
            bin_of[k], begins = bin_of[k - 1] + 1, k
    return bin_of


def _seconds(observation: Observation) -> Float[np.ndarray, " times"]:
    with unannounced_leap_seconds():
        return (observation.times - observation.times[0]).to_value(u.s)


def by_the_rule(
    present: Bool[np.ndarray, "products times"],
    bin_of: Int[np.ndarray, " times"],
    live_s: Float[np.ndarray, " times"],
) -> tuple[Bool[np.ndarray, "products bins"], Bool[np.ndarray, " times"]]:
    """Return which products each bin has, and which samples it is made of.

    Parameters
    ----------
    present : (products, times) array of bool
    bin_of : (times,) array of int
        :func:`bins_of`.
    live_s : (times,) array
        Live time of the samples, in seconds.
    """
    some = present.any(axis=0)
    first = np.searchsorted(bin_of, np.arange(bin_of[-1] + 1))
    total = np.add.reduceat(live_s * some, first)
    share = np.add.reduceat(live_s * present, first, axis=1)
    # of times that are not powers of two, a half may be short of it by rounding
    kept = (share >= LEAST_SHARE * total * (1.0 - 1e-12)) & (total > 0.0)
    used = some & kept.any(axis=0)[bin_of] & (present | ~kept[:, bin_of]).all(axis=0)
    return kept, used


def binned(
    observation: Observation,
    left: Int[np.ndarray, " samples"],
    bin_of_left: Int[np.ndarray, " samples"],
    to_s: float,
) -> Observation:
    """Return the times and windows of bins.

    Parameters
    ----------
    observation : Observation
        Of samples with windows.
    left : (samples,) array of int
        The samples that the bins are made of.
    bin_of_left : (samples,) array of int
        The bin of each of them: 0, 1, ... without a gap.
    to_s : float
        Length of the bins, in seconds.
    """
    first = np.searchsorted(bin_of_left, np.arange(bin_of_left[-1] + 1))
    keep = np.isin(np.arange(observation.n_times), left)
    here = observation.select(keep)
    windows = here.windows
    offset = _seconds(here)[windows.sample]
    start, end = windows.start_s + offset, windows.end_s + offset
    bin_of_piece, share = bin_of_left[windows.sample], windows.live_s / (end - start)
    gap = start[1:] - end[:-1]
    # the live time that the piece would have with the share of the one before
    differ = np.abs(np.diff(share)) * (end - start)[1:]
    merged = (np.diff(bin_of_piece) == 0) & (gap <= ROUNDING_S) & (differ <= ROUNDING_S)
    opens = np.append(True, ~merged)
    at = np.flatnonzero(opens)
    start, bin_of_piece = start[at], bin_of_piece[at]
    end = end[np.append(at[1:], len(end)) - 1]
    # pieces touch up to rounding
    live = np.minimum(np.add.reduceat(windows.live_s, at), end - start)
    begin = np.searchsorted(bin_of_piece, np.arange(len(first)))
    last = np.append(begin[1:], len(start)) - 1
    middle = (start[begin] + end[last]) / 2.0
    with unannounced_leap_seconds():
        times = here.times[first] + (middle - _seconds(here)[first]) * u.s
    offset = middle[bin_of_piece]
    return replace(
        here,
        times=times,
        run=here.run[first],
        step_s=to_s,
        windows=Windows(bin_of_piece, start - offset, end - offset, live),
    )
