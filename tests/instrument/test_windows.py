"""Windows of samples: averages of data by loops, A against instants, and files and arrays."""

from dataclasses import replace
from datetime import datetime, timedelta

import astropy.units as u
import numpy as np
import pytest
import xarray as xr
from assertions import assert_same, refuse, refused, within
from astropy.time import Time
from reference import galactic_directions, steep_sky, vectors

import lusee_bayes as lb
from lusee_bayes.core.harmonics import Rotation
from lusee_bayes.instrument.averaging import averaged, product_live_s
from lusee_bayes.instrument.pointing import Pointing
from lusee_bayes.instrument.products import DataLayout
from lusee_bayes.instrument.times import Windows, unannounced_leap_seconds
from lusee_bayes.instrument.visibilities import read_visibilities
from lusee_bayes.noise.radiometer import paper_variance
from lusee_bayes.report.describe import describe

# --- averages of data -----------------------------------------------------------------------------


STEP = 600.0
RUNS = [lb.Run(0.004), lb.Run(0.003, turntable_deg=30.0)]


def windows_of(pieces):
    """Of (sample, start, end, live time) of every piece."""
    sample, *rest = (np.array(column) for column in zip(*pieces, strict=True))
    return Windows(sample, *rest)


def observed(keep=None, windows="odd", runs=RUNS):
    """15 and 11 samples; every third is made of two pieces."""
    observation = lb.Observation.from_runs(runs, step_s=STEP, window="mean")
    rng, n = np.random.default_rng(7), observation.n_times
    if windows == "odd":
        found = []
        for k in range(n):
            pieces = [(-300.0, -100.0), (-40.0, 300.0)] if k % 3 == 0 else [(-300.0, 300.0)]
            share = 1.0 if k % 2 else rng.uniform(0.2, 1.0)
            found += [(k, a, b, share * (b - a)) for a, b in pieces]
        observation = replace(observation, windows=windows_of(found))
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
    w, seconds = observation.windows, seconds_of(observation, origin)
    found = [[] for _ in seconds]
    for k, a, b, live in zip(w.sample, w.start_s, w.end_s, w.live_s, strict=True):
        found[k].append((seconds[k] + a, seconds[k] + b, live))
    return found


def naive(data, to_s):
    """Bins as lists of (run, values by product, pieces), by loops over the module's rule."""
    observation, grid = data.observation, data.grid()
    there = ~np.isnan(grid)
    pieces, bins = pieces_of(observation, observation.times[0]), {}
    for k, run in enumerate(observation.run):
        place = (pieces[k][0][0] - pieces[list(observation.run).index(run)][0][0] + 1e-3) // to_s
        bins.setdefault((run, place), []).append(k)
    found = []
    for (run, _), members in bins.items():
        live = {k: sum(p[2] for p in pieces[k]) for k in members}
        members = [k for k in members if there[:, k].any()]
        half = sum(live[k] for k in members) / 2
        products = [p for p in range(16) if sum(live[k] for k in members if there[p, k]) >= half]
        members = [k for k in members if all(there[p, k] for p in products)]
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
    "a run lost": (observed(), np.where(observed().run == 0, 1.0, 0.1)),
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


@pytest.mark.parametrize("to_s", [1.5 * STEP, 2.5 * STEP, 3.25 * STEP])
def test_no_bin_is_longer_than_asked_for(to_s):
    """Samples that do not fit: bins of whole samples, none across a run, all of them there."""
    keep = np.ones(26, dtype=bool)
    keep[[2, 8]] = False
    observation = observed(keep, windows="whole")
    # what follows the gap is off the grid by a third of a sample
    late = np.where(np.arange(24) > 10, STEP / 3, 0.0)
    data = data_of(replace(observation, times=observation.times + late * u.s))
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
    values = np.random.default_rng(3).normal(size=layout.size)
    return lb.Visibilities(values, layout, observation, 25.0)


RARELY_THERE = [
    # product 5 in one of 4 samples, less than half; product 2 in three, so that one is lost
    ([(5, 0), (5, 1), (5, 2), (2, 3)], [0, 1, 2], [5]),
    # half of the samples is enough
    ([(5, 0), (5, 1)], [2, 3], []),
    # samples without any product do not count: the last one is all that there is
    ([(p, k) for p in range(16) for k in range(3)], [3], []),
]


@pytest.mark.parametrize(("absent", "kept", "lost"), RARELY_THERE)
def test_products_that_are_rarely_there_are_left_out(absent, kept, lost):
    data = flagged(*absent)
    found, expected = averaged(data, 4 * STEP), data.grid()[:, kept].mean(axis=1)
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
    for data in (rarely, flagged(*((p, k) for p in range(16) for k in range(4) if p % 2 != k % 2))):
        refuse("averages.*2400 s.*no data", averaged, data, 4 * STEP)


NOT_AVERAGED = [
    ("instant", 3600.0, "the samples are instants, which cannot be averaged"),
    ("mean", 300.0, "of 300 s is shorter than the samples .600 s"),
    ("mean", 1e9 * 86400.0, "give at most 30 days"),
    ("mean", 0.0, "the time to average over, in seconds, must be positive"),
    ("mean", np.nan, "the time to average over, in seconds, must be positive"),
]


@pytest.mark.parametrize(("windows", "to_s", "words"), NOT_AVERAGED)
def test_what_cannot_be_averaged(windows, to_s, words):
    observation = lb.Observation.from_runs([lb.Run(0.01)], step_s=STEP, window=windows)
    refuse(words, averaged, data_of(observation), to_s)


# --- A as the mean over windows -------------------------------------------------------------------


def partly_filled(n, step_s, seed=1):
    """Whole windows, windows that end early, and windows with one or two gaps."""
    rng, found = np.random.default_rng(seed), []
    for k in range(n):
        edges = np.sort(rng.uniform(-0.5, 0.5, 2 * (k % 4))) * step_s
        edges = np.concatenate([[-step_s / 2], edges, [step_s / 2]])
        if k % 4 == 1:  # one piece, without its end
            edges = edges[:2]
        for first, last in zip(edges[::2], edges[1::2], strict=True):
            found.append((k, first, last, rng.uniform(0.3, 1.0) * (last - first)))
    return windows_of(found)


def observation(step_s, filled):
    """Eight samples across a cycle, so that the pole has wandered between them."""
    whole = lb.Observation.from_runs([lb.Run(1.0, 20.0)], step_s=step_s, window="mean")
    keep = np.zeros(whole.n_times, dtype=bool)
    keep[np.linspace(0, whole.n_times - 1, 8).astype(int)] = True
    some = whole.select(keep)
    return replace(some, windows=partly_filled(8, step_s)) if filled else some


def nodes_of(windows, k, n):
    """n instants of sample k and their weights, piece by piece."""
    x, w = np.polynomial.legendre.leggauss(n)
    offsets, weights = [], []
    pieces = np.flatnonzero(windows.sample == k)
    for piece in pieces:
        a, b = windows.start_s[piece], windows.end_s[piece]
        offsets.append((a + b) / 2 + (b - a) / 2 * x)
        weights.append(w / 2 * windows.live_s[piece] / windows.live_s[pieces].sum())
    return np.concatenate(offsets), np.concatenate(weights)


def sigma_of(v, o):
    """Radiometer noise of one live time, 1 MHz wide."""
    return np.sqrt(paper_variance(v) / (1e6 * o.live_s))


@pytest.mark.parametrize("lmax", [12, pytest.param(47, marks=pytest.mark.long)])
@pytest.mark.parametrize("filled", [pytest.param(False, marks=pytest.mark.long), True])
@pytest.mark.parametrize("step_s", [10.0, 600.0, 7200.0, 43200.0])
def test_equals_the_mean_of_200_instants(step_s, filled, lmax):
    o, beams, sky = observation(step_s, filled), lb.monopole_beams(25.0, lmax), steep_sky(lmax)
    got = np.asarray(lb.CouplingMatrix.observe(beams, o) @ sky).reshape(16, -1)
    expected = np.zeros_like(got)
    for k in range(o.n_times):
        offsets, weights = nodes_of(o.windows, k, 200)
        with unannounced_leap_seconds():
            times = o.times[k] + offsets * u.s
        instants = replace(o, times=times, run=np.zeros(len(times), dtype=int), windows=None)
        pointing = Pointing.of(instants, lmax, order=4)
        v = np.asarray(lb.CouplingMatrix.build(beams, pointing) @ sky).reshape(16, -1)
        expected[:, k] = v @ weights
    assert np.abs((got - expected) / sigma_of(expected, o)).max() < 1e-6
    # and instants at the same times would not do
    instants = np.asarray(lb.CouplingMatrix.observe(beams, replace(o, windows=None)) @ sky)
    wrong = np.abs((instants.reshape(16, -1) - expected) / sigma_of(expected, o)).max()
    assert wrong > {10.0: 1e-8, 600.0: 1e-4, 7200.0: 0.1, 43200.0: 10.0}[step_s]


LENGTHS = [(7200.0, False, 12), pytest.param(43200.0, True, 47, marks=pytest.mark.long)]


@pytest.mark.parametrize(("step_s", "filled", "lmax"), LENGTHS)
def test_equals_the_mean_of_20_instants_by_lunarsky(step_s, filled, lmax):
    o, beams, sky = observation(step_s, filled), lb.monopole_beams(25.0, lmax), steep_sky(lmax)
    got = np.asarray(lb.CouplingMatrix.observe(beams, o) @ sky).reshape(16, -1)
    # the axes of the turned antennas: x, y and z
    theta = np.radians([90.0, 90.0, 0.0])
    phi = np.radians(np.array([0.0, 90.0, 0.0]) + o.turntable_deg[0])
    for k in (1, 2, 7):
        offsets, weights = nodes_of(o.windows, k, 20)
        expected = 0.0
        for offset, weight in zip(offsets, weights, strict=True):
            with unannounced_leap_seconds():
                time = o.times[k] + offset * u.s
            there = vectors(*galactic_directions(theta, phi, time, o.lon_deg, o.lat_deg))
            turned = Rotation.from_matrix(there, lmax)(sky)
            expected = expected + weight * (np.asarray(beams.modes) @ turned)
        sigma = sigma_of(np.asarray(expected)[:, None], o.select(np.arange(8) == k))
        assert np.abs((got[:, k] - expected) / sigma[:, 0]).max() < 1e-6


IMPOSSIBLE = [
    ([0], [1.0], [-1.0], [1.0], "sample 0 ends -1 s from its time, not after its start"),
    ([0], [-1.0], [1.0], [3.0], "sample 0 was live for 3 s of a window of 2 s"),
    ([0], [-1.0], [1.0], [0.0], "sample 0 has a live time of 0 s"),
    ([0, 0], [0.0, 0.5], [1.0, 2.0], [1.0, 1.0], "a piece that begins at 0.5 s, before"),
    ([0, 2], [0.0, 0.0], [1.0, 1.0], [1.0, 1.0], "must count the samples 0, 1"),
    ([], [], [], [], "at least one piece for each"),
]


@pytest.mark.parametrize(("sample", "start", "end", "live", "words"), IMPOSSIBLE)
def test_windows_that_cannot_be(sample, start, end, live, words):
    refuse(words, Windows, np.array(sample, dtype=int), *(np.array(x) for x in (start, end, live)))


def test_windows_that_samples_cannot_have():
    o = lb.Observation.from_runs([lb.Run(0.05)], window="mean")
    n = np.ones(o.n_times)
    with refused("window.*sample 0.*8000 s.*longer"):
        replace(o, windows=Windows.whole(-4000 * n, 4000 * n))
    with refused(r"samples 0 and 1 \(2027-01-15T01:00:00\).*overlap.*600"):
        replace(o, windows=Windows.whole(-3600 * n, 3600 * n + 600 * (o.hours == 0)), step_s=8e3)
    refuse("windows.*3 samples.*16 times", replace, o, windows=Windows.whole(-n[:3], n[:3]))
    refuse("that are instants; use observation.window=instant", replace, o, fixed_axis=True)


# --- windows in files and in arrays ---------------------------------------------------------------


HOUR = 3600.0
START = datetime(2027, 1, 15)
STARTS = [START + timedelta(seconds=HOUR * k) for k in range(4)]
VALUES = np.arange(4.0 * 16).reshape(4, 16)


def made(times=STARTS, **options):
    return lb.Visibilities.from_arrays(VALUES[: len(times)], times, 25.0, **options)


def bounds_of(observation):
    """Start and end of every sample in seconds from START, by datetimes of astropy."""
    seconds = (observation.times - Time(START, scale="utc")).to_value(u.s)
    return seconds[:, None] + observation.windows.bounds_s


@pytest.fixture
def data():
    """Windows in pieces of odd lengths, and flags."""
    runs = [lb.Run(0.01), lb.Run(0.01, turntable_deg=30.0)]
    observation = lb.Observation.from_runs(runs, window="mean")
    windows = partly_filled(observation.n_times, 7200.0)
    return data_of(replace(observation, windows=windows), 0.1, seed=5)


def test_windows_come_back_to_the_last_bit(data, tmp_path):
    again = read_visibilities(data.write(tmp_path / "data.nc"))
    windows = (one.observation.windows for one in (again, data))
    assert_same(*windows, "sample", "start_s", "end_s", "live_s")
    assert again.says_window and again.digest() == data.digest()


def test_the_digest_knows_windows(data):
    windows = data.observation.windows
    other = replace(windows, live_s=windows.live_s * 0.5)
    changed = replace(data, observation=replace(data.observation, windows=other))
    instants = replace(data, observation=replace(data.observation, windows=None))
    assert len({d.digest() for d in (data, changed, instants)}) == 3


def test_other_software_finds_bounds_as_the_cf_conventions_have_them(tmp_path):
    path = made(timestamp="start").write(tmp_path / "data.nc")
    with xr.open_dataset(path, engine="h5netcdf") as found:
        assert found["time_bounds"].dims[0] == "time" and found["time_bounds"].shape == (4, 2)
        expected = np.array([[s, s + timedelta(seconds=HOUR)] for s in STARTS], "datetime64[ns]")
        middles = np.array([s + timedelta(seconds=HOUR / 2) for s in STARTS], "datetime64[ns]")
        np.testing.assert_array_equal(found["time_bounds"], expected)
        np.testing.assert_array_equal(found["time"], middles)
        assert found["time"].encoding["units"] == found["time_bounds"].encoding["units"]
        np.testing.assert_allclose(found["live_time"], HOUR, rtol=0, atol=1e-8)
        assert found.attrs["Conventions"].startswith("CF-1.")
        units = {str(name): u.Unit(one.attrs.get("units", "")) for name, one in found.items()}
        assert (units["visibility"], units["jd1"], units["live_time"]) == (u.K, u.day, u.s)
    with xr.open_dataset(path, engine="h5netcdf", decode_times=False) as raw:
        assert raw["time"].attrs["bounds"] == "time_bounds"
        assert raw["time"].dtype == raw["time_bounds"].dtype


def rewritten(data, path, change):
    change(data.to_dataset()).to_netcdf(path, engine="h5netcdf")
    return path


def without_pieces(dataset):
    return dataset.drop_vars([str(n) for n in dataset.variables if str(n).startswith("piece_")])


@pytest.mark.parametrize("units", ["seconds since 2027-01-15", "days since 2027-01-01T00:00:00"])
def test_bounds_of_other_software_are_windows(tmp_path, units):
    """Without pieces, with stamps at the starts, and units that the bounds leave to the time."""

    def foreign(dataset):
        dataset = without_pieces(dataset).drop_vars("live_time")
        at_start = Time(START, scale="utc") + HOUR * np.arange(4) * u.s
        dataset["jd1"][:], dataset["jd2"][:] = at_start.jd1, at_start.jd2
        stamps = at_start.datetime64.astype("datetime64[ns]")
        dataset = dataset.assign_coords(time=("time", stamps, dataset["time"].attrs))
        dataset["live_time"] = ("time", 0.25 * HOUR * np.ones(4))
        # as xarray writes them: bounds without units of their own
        dataset["time"].encoding = {"units": units, "dtype": "float64"}
        dataset["time_bounds"].encoding = {"dtype": "float64"}
        return dataset

    path = rewritten(made(timestamp="start"), tmp_path / "foreign.nc", foreign)
    with xr.open_dataset(path, engine="h5netcdf", decode_times=False) as raw:
        assert "units" not in raw["time_bounds"].attrs
    again = read_visibilities(path)
    expected = HOUR * np.stack([np.arange(4), np.arange(1, 5)], axis=1)
    # days in double precision since New Year: 3e-7 s, and a Julian date in two parts
    np.testing.assert_allclose(bounds_of(again.observation), expected, rtol=0, atol=1e-6)
    np.testing.assert_allclose(again.observation.live_s, HOUR / 4, rtol=1e-15)
    middles = (again.observation.times - Time(START, scale="utc")).to_value(u.s)
    np.testing.assert_allclose(middles, HOUR * (np.arange(4) + 0.5), rtol=0, atol=1e-6)


def test_instants_and_silent_files(data, tmp_path):
    instants = made(timestamp="instant")
    assert instants.observation.windows is None
    path = instants.write(tmp_path / "instants.nc")
    again = read_visibilities(path)
    assert again.says_window and again.observation.windows is None
    assert "times are instants" in describe(path)

    def silent(dataset):
        del dataset.attrs["window"]
        return dataset

    path = rewritten(instants, tmp_path / "silent.nc", silent)
    again = read_visibilities(path)
    assert not again.says_window and again.observation.windows is None
    assert "meaning of the times unknown" in describe(path)
    # what does not say it does not learn it by being written
    assert not read_visibilities(again.write(tmp_path / "again.nc")).says_window
    assert "meaning of the times unknown" in repr(again)
    assert "unknown" not in repr(instants)
    started = again.stamped("start")
    np.testing.assert_allclose(bounds_of(started.observation)[:, 0], HOUR * np.arange(4), atol=1e-6)
    refuse("the data have windows", started.stamped, "end")


def test_info_says_windows_and_live_share(data, tmp_path):
    path = made(timestamp="end", live_s=[900.0] * 4).write(tmp_path / "data.nc")
    assert "4 windows in 4 pieces, live for 900 to 900 s, 25.0% of the time" in describe(path)
    text = describe(data.write(tmp_path / "pieces.nc"))
    assert f"in {len(data.observation.windows.sample)} pieces" in text


def lose(*names):
    return lambda dataset: dataset.drop_vars(names)


def attribute(name, value):
    return lambda dataset: dataset.assign_attrs({name: value})


def shifted_bounds(dataset):
    bounds = dataset["time_bounds"]
    return dataset.assign(time_bounds=(bounds.dims, bounds.values + np.timedelta64(30, "s")))


def changed(name, value):
    def change(dataset):
        values = dataset[name].values.copy()
        values[1] = value
        return dataset.assign({name: (dataset[name].dims, values)})

    return change


def numbers(dataset):
    """Bounds without units, of a time that does not name them."""
    seconds = np.stack([np.arange(4.0), np.arange(1.0, 5.0)], axis=1)
    dataset["time"].attrs.clear()
    return dataset.assign(time_bounds=(dataset["time_bounds"].dims, seconds))


def bounds_alone(change):
    return lambda dataset: change(without_pieces(dataset))


NOT_OF_A_FILE = [
    (lose("piece_end_s"), "piece_sample without piece_end_s"),
    (bounds_alone(lose("time_bounds")), "live_time without time_bounds"),
    (bounds_alone(lose("time_bounds", "live_time")), "window = 'mean' without time_bounds"),
    (attribute("window", "instant"), "declares instants, but piece_sample"),
    (attribute("window", "means"), "window is 'means'; did you mean 'mean'"),
    (shifted_bounds, "time_bounds and the pieces of sample 0 differ by 30 s"),
    (changed("live_time", 7.0), "live_time and the pieces of sample 1 differ"),
    (changed("piece_start_s", np.nan), "piece_start_s.*NaN"),
    (changed("piece_sample", 0), "at least one piece for each"),
    (bounds_alone(changed("live_time", -1.0)), "sample 1 has a live time of -1 s"),
    (bounds_alone(changed("time_bounds", np.datetime64("NaT", "ns"))), "time_bounds has no time"),
    (bounds_alone(numbers), "time_bounds has values of type float64, expected times"),
]


@pytest.mark.parametrize(("change", "words"), NOT_OF_A_FILE)
def test_windows_that_a_file_cannot_have(tmp_path, change, words):
    path = rewritten(made(), tmp_path / "bad.nc", change)
    with refused(words) as caught:
        read_visibilities(path)
    assert str(caught.value).startswith(str(path))


# --- arrays -------------------------------------------------------------------------------------


@pytest.mark.parametrize(("timestamp", "shift"), [("start", 0.0), ("middle", -0.5), ("end", -1.0)])
def test_timestamps(timestamp, shift):
    observation, start = made(timestamp=timestamp).observation, HOUR * (np.arange(4) + shift)
    # a Julian date in two parts is exact to less than a nanosecond, offsets of hours to 1e-12
    within(bounds_of(observation), np.stack([start, start + HOUR], axis=1), 1e-8)
    np.testing.assert_allclose(observation.windows.bounds_s.sum(axis=1), 0.0, atol=1e-12)
    # the median of steps between Julian dates
    np.testing.assert_allclose(observation.live_s, HOUR, rtol=0, atol=1e-8)


def test_middles_are_the_default_and_steps_may_be_shorter_than_the_times():
    observation = made(step_s=600.0, live_s=[60.0, 600.0, 1.0, 599.0]).observation
    start = HOUR * np.arange(4) - 300.0
    within(bounds_of(observation), np.stack([start, start + 600.0], axis=1), 1e-8)
    np.testing.assert_array_equal(observation.live_s, [60.0, 600.0, 1.0, 599.0])


def test_bounds_of_any_kind_of_times():
    bounds = [[s, s + timedelta(seconds=1000.0 + 100.0 * k)] for k, s in enumerate(STARTS)]
    words = [[one.isoformat() for one in pair] for pair in bounds]
    for one in (bounds, words, np.array(bounds, dtype="datetime64[us]"), Time(bounds, scale="utc")):
        observation = made(bounds=one, live_s=np.full(4, 500.0)).observation
        start = HOUR * np.arange(4)
        expected = np.stack([start, start + 1000.0 + 100.0 * np.arange(4)], axis=1)
        np.testing.assert_allclose(bounds_of(observation), expected, rtol=0, atol=1e-8)
        np.testing.assert_allclose(observation.windows.bounds_s.sum(axis=1), 0.0, atol=1e-9)
        assert observation.step_s == pytest.approx(HOUR, abs=1e-8)
        np.testing.assert_array_equal(observation.live_s, 500.0)
    alone = made(times=STARTS[:1], bounds=bounds[:1]).observation
    assert alone.step_s == pytest.approx(1000.0, abs=1e-8)


def test_rounded_times_make_no_overlaps():
    """Julian dates in one number are exact to 4e-5 s, so that half of the steps are too short."""
    starts = Time(START, scale="utc") + 60.0 * np.arange(400) * u.s
    rounded, data = Time(starts.jd, format="jd", scale="utc"), np.zeros((400, 16))
    edges = np.random.default_rng(1).uniform(-2e-5, 2e-5, (400, 2))
    edges = starts[:, None] + (edges + np.array([0.0, 60.0])) * u.s
    step = {"step_s": 60.0}
    for options in ({}, step, step | {"live_s": np.full(400, 60.0)}, {"bounds": edges}):
        series = lb.Visibilities.from_arrays(data, rounded, 25.0, timestamp="start", **options)
        observation = series.observation
        found = bounds_of(observation)
        assert (found[1:, 0] >= found[:-1, 1] - 1e-6).all()
        np.testing.assert_allclose(found[:, 0], 60.0 * np.arange(400), rtol=0, atol=1e-4)
        np.testing.assert_allclose(observation.live_s, 60.0, rtol=0, atol=1e-4)


PAIRS = [[s, s + timedelta(seconds=HOUR)] for s in STARTS]


WRONG = [
    ({"timestamp": "begin"}, "unknown timestamp 'begin'; did you mean"),
    ({"timestamp": "instant", "live_s": [1.0] * 4}, "instants have no live time"),
    ({"timestamp": "instant", "bounds": PAIRS}, "instants have no bounds"),
    ({"live_s": [1.0] * 3}, "live_s has shape (3,); give one finite number, or one for each"),
    ({"live_s": "all"}, "live_s is 'all'; give one finite number"),
    ({"live_s": [1.0, 0.0, 1.0, 3.0]}, "leave out samples in which nothing was integrated"),
    ({"step_s": 4000.0}, "windows of samples 0 and 1 (2027-01-15T00:00:00) overlap by 400 s"),
    ({"bounds": PAIRS[:3]}, "bounds have shape (3, 2), expected (4, 2)"),
    ({"bounds": [["now", "then"]] * 4}, "bounds, row by row: time 0 'now' is not a date"),
    ({"bounds": [pair[::-1] for pair in PAIRS]}, "windows need a start and then an end"),
    ({"bounds": PAIRS[::-1]}, "the time of sample 0 (2027-01-15T00:00:00) is not within"),
    ({"bounds": PAIRS, "step_s": 1800.0}, "lasts 3600 s, longer than the step .* .1800 s"),
]


@pytest.mark.parametrize(("options", "words"), WRONG)
def test_what_is_wrong_is_said_in_a_sentence(options, words):
    refuse(words, made, **options)
