"""Averages of data: values, windows and live times as loops over the samples have them."""

from __future__ import annotations

from dataclasses import replace

import astropy.units as u
import numpy as np
import pytest

import lusee_bayes as lb
from lusee_bayes.instrument.averaging import averaged, product_live_s
from lusee_bayes.instrument.layout import DataLayout
from lusee_bayes.instrument.windows import Windows

STEP = 600.0
RUNS = [lb.Run(0.004), lb.Run(0.003, turntable_deg=30.0)]


def observed(keep=None, windows="odd", runs=RUNS):
    """15 and 11 samples; every third is made of two pieces."""
    observation = lb.Observation.from_runs(runs, step_s=STEP, window="mean")
    rng = np.random.default_rng(7)
    n = observation.n_times
    if windows == "odd":
        sample, start, end, live = [], [], [], []
        for k in range(n):
            pieces = [(-300.0, -100.0), (-40.0, 300.0)] if k % 3 == 0 else [(-300.0, 300.0)]
            share = 1.0 if k % 2 else rng.uniform(0.2, 1.0)
            for a, b in pieces:
                sample, start, end = [*sample, k], [*start, a], [*end, b]
                live.append(share * (b - a))
        made = Windows(np.array(sample), np.array(start), np.array(end), np.array(live))
        observation = replace(observation, windows=made)
    return observation if keep is None else observation.select(keep)


def data_of(observation, flagged=0.0, seed=1):
    rng = np.random.default_rng(seed)
    layout = DataLayout.from_flags(rng.random((16, observation.n_times)) < flagged)
    values = rng.normal(3e4, 1e3, layout.size)
    return lb.Visibilities(values, layout, observation, 25.0, truth=rng.normal(size=9))


def seconds_of(observation, origin):
    return (observation.times - origin).to_value(u.s)


def pieces_of(observation, origin):
    """(start, end, live) of every piece of every sample, in seconds from one time."""
    windows, seconds = observation.windows, seconds_of(observation, origin)
    found = [[] for _ in seconds]
    for k, a, b, live in zip(
        windows.sample, windows.start_s, windows.end_s, windows.live_s, strict=True
    ):
        found[k].append((seconds[k] + a, seconds[k] + b, live))
    return found


def naive(data, to_s):
    """Bins as lists of (run, values by product, pieces), by loops over the module's rule."""
    observation, grid = data.observation, data.grid()
    pieces = pieces_of(observation, observation.times[0])
    bins = {}
    for k, run in enumerate(observation.run):
        first = list(observation.run).index(run)
        place = (pieces[k][0][0] - pieces[first][0][0] + 1e-3) // to_s
        bins.setdefault((run, place), []).append(k)
    found = []
    for (run, _), members in bins.items():
        live = {k: sum(p[2] for p in pieces[k]) for k in members}
        members = [k for k in members if not np.isnan(grid[:, k]).all()]
        total = sum(live[k] for k in members)
        products = [
            p
            for p in range(16)
            if sum(live[k] for k in members if not np.isnan(grid[p, k])) >= total / 2
        ]
        members = [k for k in members if not any(np.isnan(grid[p, k]) for p in products)]
        if not members or not products:
            continue
        weight = sum(live[k] for k in members)
        values = {p: sum(live[k] * grid[p, k] for k in members) / weight for p in products}
        merged = []
        for piece in (p for k in members for p in pieces[k]):
            start, end, lived = piece
            share = lived / (end - start)
            if merged and abs(merged[-1][1] - start) < 1e-6:
                a, _, before = merged[-1]
                if abs(before / (merged[-1][1] - a) - share) < 1e-9:
                    merged[-1] = (a, end, before + lived)
                    continue
            merged.append(piece)
        found.append((run, values, merged))
    return found


CASES = {
    "whole": (observed(), 0.0),
    "flags": (observed(), 0.15),
    "many flags": (observed(), 0.55),
    "gaps": (observed(np.arange(26) % 7 != 3), 0.1),
    "one window each": (observed(windows="whole"), 0.1),
}


@pytest.mark.parametrize("to_s", [STEP, 3 * STEP, 5 * STEP, 1e5])
@pytest.mark.parametrize("case", CASES)
def test_values_windows_and_live_times_are_those_of_loops(case, to_s):
    data = data_of(*CASES[case])
    found, expected = averaged(data, to_s), naive(data, to_s)
    observation = found.observation
    assert observation.step_s == to_s and observation.n_times == len(expected)
    origin = data.observation.times[0]
    grid, pieces = found.grid(), pieces_of(observation, origin)
    middles = seconds_of(observation, origin)
    for k, (run, values, expected_pieces) in enumerate(expected):
        assert data.observation.turntable_deg[run] == observation.turntable_deg[observation.run[k]]
        column = np.full(16, np.nan)
        column[list(values)] = list(values.values())
        np.testing.assert_allclose(grid[:, k], column, rtol=1e-12)
        # seconds over days, of Julian dates in two parts
        np.testing.assert_allclose(pieces[k], expected_pieces, rtol=0, atol=1e-6)
        middle = (expected_pieces[0][0] + expected_pieces[-1][1]) / 2
        assert middles[k] == pytest.approx(middle, abs=1e-6)
    assert found.frequency_mhz == data.frequency_mhz
    np.testing.assert_array_equal(found.truth, data.truth)


@pytest.mark.parametrize("to_s", [STEP, 2.5 * STEP, 7 * STEP, 1e6])
def test_live_time_times_value_is_conserved(to_s):
    data = data_of(observed())
    after = averaged(data, to_s)

    def integral(data):
        return data.grid() @ data.observation.live_s

    np.testing.assert_allclose(integral(after), integral(data), rtol=1e-12)
    assert product_live_s(after) == pytest.approx(product_live_s(data), rel=1e-12)


@pytest.mark.parametrize("to_s", [1.5 * STEP, 2.5 * STEP, 3.25 * STEP])
def test_no_bin_is_longer_than_asked_for(to_s):
    """Samples that do not fit: bins of whole samples, none across a run, all of them there."""
    keep = np.ones(26, dtype=bool)
    keep[[2, 8]] = False
    observation = observed(keep, windows="whole")
    # what follows the gap is off the grid by a third of a sample
    late = np.where(np.arange(24) > 10, STEP / 3, 0.0)
    observation = replace(observation, times=observation.times + late * u.s)
    data = data_of(observation)
    after = averaged(data, to_s)
    bounds = after.observation.windows.bounds_s
    assert (bounds[:, 1] - bounds[:, 0] <= to_s + 1e-6).all()
    assert after.observation.n_times < data.observation.n_times or to_s < 2 * STEP
    assert after.observation.live_s.sum() == pytest.approx(24 * STEP, rel=1e-12)
    assert after.observation.n_runs == 2


# --- flags --------------------------------------------------------------------------------------


def flagged(*absent, n=4):
    """``n`` samples of one run, of equal live times, without some (product, sample)."""
    observation = lb.Observation.from_runs([lb.Run(0.02)], step_s=STEP, window="mean")
    observation = observation.select(np.arange(observation.n_times) < n)
    flags = np.zeros((16, n), dtype=bool)
    for product, sample in absent:
        flags[product, sample] = True
    layout = DataLayout.from_flags(flags)
    return lb.Visibilities(
        np.random.default_rng(3).normal(size=layout.size), layout, observation, 25.0
    )


@pytest.mark.parametrize(
    ("absent", "kept", "lost"),
    [
        # product 5 in one of 4 samples, less than half; product 2 in three, so that one is lost
        ([(5, 0), (5, 1), (5, 2), (2, 3)], [0, 1, 2], [5]),
        # half of the samples is enough
        ([(5, 0), (5, 1)], [2, 3], []),
        # samples without any product do not count: the last one is all that there is
        ([(p, k) for p in range(16) for k in range(3)], [3], []),
    ],
)
def test_products_that_are_rarely_there_are_left_out(absent, kept, lost):
    data = flagged(*absent)
    found = averaged(data, 4 * STEP)
    expected = data.grid()[:, kept].mean(axis=1)
    expected[lost] = np.nan
    np.testing.assert_allclose(found.grid()[:, 0], expected, rtol=1e-12)
    assert found.observation.live_s == pytest.approx(len(kept) * STEP)
    share = len(kept) * (16 - len(lost)) / (64 - len(absent))
    assert product_live_s(found) / product_live_s(data) == pytest.approx(share)


def test_bins_of_which_nothing_remains_are_dropped():
    data = flagged(*((p, k) for p in range(16) for k in (0, 1)))
    found = averaged(data, 2 * STEP)
    assert found.observation.n_times == 1 and found.n_missing == 0
    # no product is there for half of the time, or none with another
    rarely = flagged(*((p, k) for p in range(16) for k in range(4) if p % 4 != k))
    halves = flagged(*((p, k) for p in range(16) for k in range(4) if p % 2 != k % 2))
    for data in (rarely, halves):
        with pytest.raises(lb.InputError, match="nothing is left of the data in bins of 2400 s"):
            averaged(data, 4 * STEP)


def test_a_run_of_which_nothing_remains_is_gone():
    observation = observed()
    flags = np.zeros((16, observation.n_times), dtype=bool)
    flags[:, observation.run == 0] = True
    layout = DataLayout.from_flags(flags)
    data = lb.Visibilities(np.ones(layout.size), layout, observation, 25.0)
    found = averaged(data, 3 * STEP).observation
    assert found.turntable_deg == (30.0,) and set(found.run) == {0}


@pytest.mark.parametrize(
    ("windows", "to_s", "words"),
    [
        ("instant", 3600.0, "the samples are instants, which have no mean over a time"),
        ("mean", 300.0, "over 300 s, which is shorter than their samples of 600 s"),
        ("mean", 1e9 * 86400.0, "give at most 30 days"),
        ("mean", 0.0, "the time to average over, in seconds, must be positive"),
        ("mean", np.nan, "the time to average over, in seconds, must be positive"),
    ],
)
def test_what_cannot_be_averaged(windows, to_s, words):
    observation = lb.Observation.from_runs([lb.Run(0.01)], step_s=STEP, window=windows)
    with pytest.raises(lb.InputError) as caught:
        averaged(data_of(observation), to_s)
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)
