"""Files of data and scenarios about what times are: one of them has to say it, and not both."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from fits_files import write_images

from lusee_bayes.core.errors import InputError
from lusee_bayes.experiment.data_files import digest_of, items_of, read_data
from lusee_bayes.experiment.experiment import build
from lusee_bayes.experiment.setup import set_up
from lusee_bayes.instrument.averaging import averaged
from lusee_bayes.instrument.observation import Observation
from lusee_bayes.instrument.schedule import Run
from lusee_bayes.instrument.visibilities import Visibilities, read_visibilities
from lusee_bayes.instrument.waterfalls import write_waterfall
from lusee_bayes.testing.cases import small_scenario
from lusee_bayes.testing.checks import assert_refused

STEP = 7200.0
# from the stamps to the beginning of the windows
TO_START = {"start": 0.0, "middle": -0.5, "end": -1.0}


def file_of(folder, window):
    """Of samples with windows or instants; of neither, where ``window`` is None."""
    observation = Observation.from_runs([Run(0.02)], window=window or "instant")
    n = observation.n_times
    data = np.random.default_rng(2).normal(3e4, 1e2, (n, 16))
    made = Visibilities.from_arrays(
        data, observation.times, 25.0, timestamp="instant" if window != "mean" else "middle"
    )
    dataset = made.to_dataset()
    if window is None:
        del dataset.attrs["window"]
    path = folder / "data.nc"
    dataset.to_netcdf(path, engine="h5netcdf")
    return path, observation


def scenario(*overrides):
    return small_scenario(*overrides, lmax=2, cycles=0.02)


def test_data_come_as_paths_or_in_memory(tmp_path, monkeypatch):
    """A string, ~ of a user, several frequencies: the same data by every way."""
    monkeypatch.setenv("HOME", str(tmp_path))
    path, _ = file_of(tmp_path, "mean")
    read = read_visibilities(path)
    for given in (path, str(path), "~/data.nc", [str(path)], read, (read,)):
        found = read_data(given, scenario())
        assert found.digest() == read.digest() == digest_of(found)
    other = replace(read, frequency_mhz=30.0)
    there = read_data([read, other], scenario("frequency_mhz=30"))
    assert there.frequency_mhz == 30.0
    averages = read_data(read, scenario(f"observation.average_s={2 * STEP}"))
    assert averages.digest() == averaged(read, 2 * STEP).digest()
    for given, noun in (
        ([read, other], "none of them at 20 MHz"),
        ([read, path], "not in both"),
        ([], "no data"),
    ):
        with pytest.raises(InputError, match=noun):
            read_data(given, scenario("frequency_mhz=20"))
    for given in (np.zeros(3), [3.0]):
        assert_refused(lambda given=given: items_of(given))


def test_a_truth_of_another_lmax_is_cut_or_filled():
    """Data that are simulated at one lmax and mapped at others."""
    made = build(scenario()).data
    for lmax in (1, 2, 4):
        truth = build(small_scenario(lmax=lmax, cycles=0.02), made).data.truth
        n = min(9, (lmax + 1) ** 2)
        assert truth.shape == ((lmax + 1) ** 2,)
        np.testing.assert_array_equal(truth[:n], made.truth[:n])
        assert not truth[n:].any()


@pytest.mark.parametrize("timestamp", TO_START)
def test_a_scenario_says_what_a_file_does_not(tmp_path, timestamp):
    path, stamps = file_of(tmp_path, None)
    # what is simulated is no matter of data
    for window in ("mean", "instant"):
        given = scenario(f"observation.timestamp={timestamp}", f"observation.window={window}")
        found = read_data(path, given).observation
        start = (found.times - stamps.times).sec + found.windows.bounds_s[:, 0]
        # Julian dates in two parts
        np.testing.assert_allclose(start, TO_START[timestamp] * STEP, rtol=0, atol=1e-6)
        np.testing.assert_allclose(found.live_s, STEP, rtol=0, atol=1e-6)
    instants = read_data(path, scenario("observation.timestamp=instant"))
    assert instants.observation.windows is None and instants.says_window


@pytest.mark.parametrize("window", ["mean", "instant"])
def test_a_file_that_says_it_is_believed_whatever_is_simulated(tmp_path, window):
    path, _ = file_of(tmp_path, window)
    agreeing = "middle" if window == "mean" else "instant"
    for more in ([], ["observation.window=instant"], [f"observation.timestamp={agreeing}"]):
        found = read_data(path, scenario(*more))
        assert (found.observation.windows is None) == (window == "instant")


@pytest.mark.parametrize(
    ("window", "timestamp", "words"),
    [
        (None, None, "neither time_bounds nor the attribute window = 'instant'"),
        (None, None, "tens to hundreds of standard deviations"),
        (None, None, "use --set observation.timestamp=start (or middle, end, instant)"),
        ("instant", "start", "says that its samples are instants, the scenario that their times"),
        ("mean", "start", "says that its samples are means over windows"),
        ("mean", "instant", "observation.timestamp=instant; leave that out"),
    ],
)
def test_what_is_unclear_or_contradicts_is_refused(tmp_path, window, timestamp, words):
    path, _ = file_of(tmp_path, window)
    given = [] if timestamp is None else [f"observation.timestamp={timestamp}"]
    with pytest.raises(InputError) as caught:
        read_data(path, scenario(*given))
    assert words in str(caught.value)
    assert str(caught.value).startswith(str(path))
    assert "\n" not in str(caught.value)


def test_no_experiment_of_data_with_unclear_times(tmp_path):
    data = read_visibilities(file_of(tmp_path, None)[0])
    with pytest.raises(InputError, match="do not say what their times are; use data.stamped"):
        set_up(scenario(), data)


def test_no_fixed_axis_of_data_with_windows(tmp_path):
    data = read_visibilities(file_of(tmp_path, "mean")[0])
    with pytest.raises(InputError, match="means over windows.*leave out observation.fixed_axis"):
        set_up(scenario("observation.fixed_axis=true"), data)


def test_data_are_averaged_on_reading(tmp_path):
    path, _ = file_of(tmp_path, "mean")
    found = read_data(path, scenario(f"observation.average_s={2 * STEP}"))
    assert found.digest() == averaged(read_visibilities(path), 2 * STEP).digest()
    assert found.observation.step_s == 2 * STEP
    for more, words in (
        (f"observation.average_s={STEP / 2}", "shorter than their samples of 7200 s"),
        ("observation.average_s=-1", "greater than 0"),
    ):
        with pytest.raises(InputError, match=words):
            read_data(path, scenario(more))


def test_waterfalls_are_instants_unless_the_scenario_says_other(tmp_path):
    header = {
        "LUNAR_DAY": "2027-02-01 00:00:00 to 2027-02-02 00:00:00",
        "DELTAT_SEC": STEP,
        "LUN_LAT_DEG": -23.814,
        "LUN_LONG_DEG": 182.258,
    }
    images = {
        "data": np.full((12, 16, 1), 3e4),
        "freq": np.array([25.0]),
        "combinations": np.array([[i, j] for i in range(4) for j in range(i, 4)]),
    }
    path = write_images(tmp_path / "w.fits", images, header)
    found = read_data(path, scenario())
    assert found.observation.windows is None and found.says_window
    started = read_data(path, scenario("observation.timestamp=start")).observation
    late = (started.times - found.observation.times).sec
    np.testing.assert_allclose(late, STEP / 2, rtol=0, atol=1e-6)
    np.testing.assert_allclose(started.windows.bounds_s, [[-STEP / 2, STEP / 2]] * 12)
    assert read_data(path, scenario("observation.timestamp=instant")).digest() == found.digest()
    with pytest.raises(InputError, match=r"w\.fits: the samples are instants"):
        read_data(path, scenario("observation.average_s=14400"))


def test_waterfalls_have_no_room_for_windows(tmp_path):
    experiment = build(scenario("observation.window=mean"))
    with pytest.raises(InputError, match=r"no room for windows.*observation\.window=instant"):
        write_waterfall(tmp_path / "w.fits", 2 * [experiment.data])
    assert not list(tmp_path.iterdir())
