"""What the times of data are: said in files and in arrays, exact, and refused where unclear."""

from __future__ import annotations

from dataclasses import replace
from datetime import datetime, timedelta

import astropy.units as u
import numpy as np
import pytest
import xarray as xr
from astropy.time import Time
from closeness import within

import lusee_bayes as lb
from lusee_bayes.instrument.layout import DataLayout
from lusee_bayes.instrument.windows import Windows
from lusee_bayes.report.describe import describe

STEP = 3600.0
START = datetime(2027, 1, 15)
STARTS = [START + timedelta(seconds=STEP * k) for k in range(4)]
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
    observation = lb.Observation.from_runs(
        [lb.Run(0.01), lb.Run(0.01, turntable_deg=30.0)], window="mean"
    )
    n = observation.n_times
    rng = np.random.default_rng(5)
    edges = np.sort(rng.uniform(-3600.0, 3600.0, (n, 4)), axis=1)
    start, end = edges[:, ::2].ravel(), edges[:, 1::2].ravel()
    live = (end - start) * rng.uniform(0.3, 1.0, 2 * n)
    windows = Windows(np.repeat(np.arange(n), 2), start, end, live)
    observation = replace(observation, windows=windows)
    layout = DataLayout.from_flags(rng.random((16, n)) < 0.1)
    return lb.Visibilities(rng.normal(size=layout.size), layout, observation, 25.0)


def test_windows_come_back_to_the_last_bit(data, tmp_path):
    again = lb.read_visibilities(data.write(tmp_path / "data.nc"))
    for name in ("sample", "start_s", "end_s", "live_s"):
        there, here = (getattr(d.observation.windows, name) for d in (data, again))
        np.testing.assert_array_equal(here, there)
    assert again.says_window
    assert again.digest() == data.digest()


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
        expected = np.array([[s, s + timedelta(seconds=STEP)] for s in STARTS], "datetime64[ns]")
        middles = np.array([s + timedelta(seconds=STEP / 2) for s in STARTS], "datetime64[ns]")
        np.testing.assert_array_equal(found["time_bounds"], expected)
        np.testing.assert_array_equal(found["time"], middles)
        assert found["time"].encoding["units"] == found["time_bounds"].encoding["units"]
        np.testing.assert_allclose(found["live_time"], STEP, rtol=0, atol=1e-8)
    with xr.open_dataset(path, engine="h5netcdf", decode_times=False) as raw:
        assert raw["time"].attrs["bounds"] == "time_bounds"
        assert raw["time"].dtype == raw["time_bounds"].dtype


def rewritten(data, path, change):
    dataset = data.to_dataset()
    change(dataset).to_netcdf(path, engine="h5netcdf")
    return path


def without_pieces(dataset):
    return dataset.drop_vars([str(n) for n in dataset.variables if str(n).startswith("piece_")])


@pytest.mark.parametrize("units", ["seconds since 2027-01-15", "days since 2027-01-01T00:00:00"])
def test_bounds_of_other_software_are_windows(tmp_path, units):
    """Without pieces, with stamps at the starts, and units that the bounds leave to the time."""

    def foreign(dataset):
        dataset = without_pieces(dataset).drop_vars("live_time")
        at_start = Time(START, scale="utc") + STEP * np.arange(4) * u.s
        dataset["jd1"][:], dataset["jd2"][:] = at_start.jd1, at_start.jd2
        dataset["live_time"] = ("time", 0.25 * STEP * np.ones(4))
        # as xarray writes them: bounds without units of their own
        dataset["time"].encoding = {"units": units, "dtype": "float64"}
        dataset["time_bounds"].encoding = {"dtype": "float64"}
        return dataset

    path = rewritten(made(timestamp="start"), tmp_path / "foreign.nc", foreign)
    with xr.open_dataset(path, engine="h5netcdf", decode_times=False) as raw:
        assert "units" not in raw["time_bounds"].attrs
    again = lb.read_visibilities(path)
    expected = STEP * np.stack([np.arange(4), np.arange(1, 5)], axis=1)
    # days in double precision since New Year: 3e-7 s, and a Julian date in two parts
    np.testing.assert_allclose(bounds_of(again.observation), expected, rtol=0, atol=1e-6)
    np.testing.assert_allclose(again.observation.live_s, STEP / 4, rtol=1e-15)
    middles = (again.observation.times - Time(START, scale="utc")).to_value(u.s)
    np.testing.assert_allclose(middles, STEP * (np.arange(4) + 0.5), rtol=0, atol=1e-6)


def test_instants_and_silent_files(data, tmp_path):
    instants = made(timestamp="instant")
    assert instants.observation.windows is None
    path = instants.write(tmp_path / "instants.nc")
    again = lb.read_visibilities(path)
    assert again.says_window and again.observation.windows is None
    assert "times are instants" in describe(path)

    def silent(dataset):
        del dataset.attrs["window"]
        return dataset

    path = rewritten(instants, tmp_path / "silent.nc", silent)
    again = lb.read_visibilities(path)
    assert not again.says_window and again.observation.windows is None
    assert "does not say what its times are" in describe(path)
    # what does not say it does not learn it by being written
    assert not lb.read_visibilities(again.write(tmp_path / "again.nc")).says_window
    assert "it is not known what the times are" in repr(again)
    assert "not known" not in repr(instants)
    started = again.stamped("start")
    np.testing.assert_allclose(bounds_of(started.observation)[:, 0], STEP * np.arange(4), atol=1e-6)
    with pytest.raises(lb.InputError, match="the data have windows"):
        started.stamped("end")


def test_info_says_windows_and_live_share(data, tmp_path):
    path = made(timestamp="end", live_s=[900.0] * 4).write(tmp_path / "data.nc")
    assert "times are middles of windows of 3600 s, live for 25.0% of them" in describe(path)
    text = describe(data.write(tmp_path / "pieces.nc"))
    assert f"in {2 * data.observation.n_times} pieces" in text


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


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lose("piece_end_s"), "there is piece_sample, but no piece_end_s"),
        (bounds_alone(lose("time_bounds")), "there is live_time, but no time_bounds"),
        (bounds_alone(lose("time_bounds", "live_time")), "window = 'mean', but no time_bounds"),
        (attribute("window", "instant"), "says that the samples are instants, and piece_sample"),
        (attribute("window", "means"), "window is 'means'; did you mean 'mean'"),
        (shifted_bounds, "time_bounds and the pieces of sample 0 differ by 30 s"),
        (changed("piece_end_s", -2000.0), "sample 1 ends -2000 s from its time, not after"),
        (changed("piece_start_s", np.nan), "piece_start_s holds NaN"),
        (changed("piece_sample", 0), "at least one piece for each"),
        (changed("piece_live_s", 4000.0), "sample 1 was live for 4000 s of a window of 3600 s"),
        (bounds_alone(changed("live_time", 4000.0)), "sample 1 was live for 4000 s"),
        (bounds_alone(changed("live_time", -1.0)), "sample 1 has a live time of -1 s"),
        (bounds_alone(changed("time_bounds", np.datetime64("NaT"))), "time_bounds holds no time"),
        (bounds_alone(numbers), "time_bounds holds values of type float64, expected times"),
    ],
)
def test_windows_that_a_file_cannot_have(tmp_path, change, words):
    path = rewritten(made(), tmp_path / "bad.nc", change)
    with pytest.raises(lb.InputError) as caught:
        lb.read_visibilities(path)
    assert words in str(caught.value)
    assert str(caught.value).startswith(str(path))
    assert "\n" not in str(caught.value)


# --- arrays -------------------------------------------------------------------------------------


@pytest.mark.parametrize(("timestamp", "shift"), [("start", 0.0), ("middle", -0.5), ("end", -1.0)])
def test_timestamps(timestamp, shift):
    observation = made(timestamp=timestamp).observation
    start = STEP * (np.arange(4) + shift)
    # a Julian date in two parts is exact to less than a nanosecond, offsets of hours to 1e-12
    within(bounds_of(observation), np.stack([start, start + STEP], axis=1), 1e-8)
    np.testing.assert_allclose(observation.windows.bounds_s.sum(axis=1), 0.0, atol=1e-12)
    # the median of steps between Julian dates
    np.testing.assert_allclose(observation.live_s, STEP, rtol=0, atol=1e-8)


def test_middles_are_the_default_and_steps_may_be_shorter_than_the_times():
    observation = made(step_s=600.0, live_s=[60.0, 600.0, 1.0, 599.0]).observation
    start = STEP * np.arange(4) - 300.0
    within(bounds_of(observation), np.stack([start, start + 600.0], axis=1), 1e-8)
    np.testing.assert_array_equal(observation.live_s, [60.0, 600.0, 1.0, 599.0])


def test_bounds_of_any_kind_of_times():
    bounds = [[s, s + timedelta(seconds=1000.0 + 100.0 * k)] for k, s in enumerate(STARTS)]
    given = (
        bounds,
        [[one.isoformat() for one in pair] for pair in bounds],
        np.array(bounds, dtype="datetime64[us]"),
        Time(bounds, scale="utc"),
    )
    for one in given:
        observation = made(bounds=one, live_s=np.full(4, 500.0)).observation
        start = STEP * np.arange(4)
        expected = np.stack([start, start + 1000.0 + 100.0 * np.arange(4)], axis=1)
        np.testing.assert_allclose(bounds_of(observation), expected, rtol=0, atol=1e-8)
        np.testing.assert_allclose(observation.windows.bounds_s.sum(axis=1), 0.0, atol=1e-9)
        assert observation.step_s == pytest.approx(STEP, abs=1e-8)
        np.testing.assert_array_equal(observation.live_s, 500.0)
    alone = made(times=STARTS[:1], bounds=bounds[:1]).observation
    assert alone.step_s == pytest.approx(1000.0, abs=1e-8)


def test_rounded_times_make_no_overlaps():
    """Julian dates in one number are exact to 4e-5 s, so that half of the steps are too short."""
    starts = Time(START, scale="utc") + 60.0 * np.arange(400) * u.s
    rounded = Time(starts.jd, format="jd", scale="utc")
    data = np.zeros((400, 16))
    edges = np.random.default_rng(1).uniform(-2e-5, 2e-5, (400, 2))
    edges = starts[:, None] + (edges + np.array([0.0, 60.0])) * u.s
    for options in (
        {},
        {"step_s": 60.0},
        {"step_s": 60.0, "live_s": np.full(400, 60.0)},
        {"bounds": edges},
    ):
        observation = lb.Visibilities.from_arrays(
            data, rounded, 25.0, timestamp="start", **options
        ).observation
        found = bounds_of(observation)
        assert (found[1:, 0] >= found[:-1, 1] - 1e-6).all()
        np.testing.assert_allclose(found[:, 0], 60.0 * np.arange(400), rtol=0, atol=1e-4)
        np.testing.assert_allclose(observation.live_s, 60.0, rtol=0, atol=1e-4)


PAIRS = [[s, s + timedelta(seconds=STEP)] for s in STARTS]


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"timestamp": "begin"}, "unknown timestamp 'begin'; did you mean"),
        ({"timestamp": "instant", "live_s": [1.0] * 4}, "instants have no live time"),
        ({"timestamp": "instant", "bounds": PAIRS}, "instants have no bounds"),
        ({"live_s": [1.0] * 3}, "live_s has shape (3,); give a finite number for each of 4"),
        ({"live_s": [1.0, 2.0, np.nan, 3.0]}, "give a finite number for each of 4 times"),
        ({"live_s": "all"}, "live_s is 'all'; give a number for each time"),
        ({"live_s": [1.0, 2.0, 3700.0, 3.0]}, "sample 2 was live for 3700 s of a window of 3600"),
        ({"live_s": [1.0, 0.0, 1.0, 3.0]}, "leave out samples in which nothing was integrated"),
        ({"step_s": 4000.0}, "windows of samples 0 and 1 (2027-01-15T00:00:00) overlap by 400 s"),
        ({"bounds": PAIRS[:3]}, "bounds have shape (3, 2), expected (4, 2)"),
        ({"bounds": [["now", "then"]] * 4}, "bounds, taken row by row: time 0 'now' is not a date"),
        ({"bounds": [pair[::-1] for pair in PAIRS]}, "windows need a start and then an end"),
        ({"bounds": PAIRS[::-1]}, "the time of sample 0 (2027-01-15T00:00:00) is not within"),
        ({"bounds": PAIRS, "step_s": 1800.0}, "lasts 3600 s, longer than the step of 1800 s"),
        (
            {"bounds": [[a, b + timedelta(seconds=500)] for a, b in PAIRS], "step_s": 4100.0},
            "overlap by 500 s",
        ),
    ],
)
def test_what_is_wrong_is_said_in_a_sentence(options, words):
    with pytest.raises(lb.InputError) as caught:
        made(**options)
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)
