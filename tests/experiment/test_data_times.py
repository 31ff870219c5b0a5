"""Times of data: what files and scenarios say of them, schedules, and maps of averages.

Maps of averages are compared with those of the fine samples that they are made of. These are so
short that an instant in their middle stands for them: what A knows of windows does not enter their
map. Averages are a part of what the fine samples say. So, over draws of sky and noise, the mean of
their map differs from that of the fine samples with the covariance C_avg - C_fine, and
``log2 det(C_avg C_fine^-1) / 2`` bits are lost.
"""

from dataclasses import replace
from typing import NamedTuple

import h5py
import numpy as np
import pytest
from assertions import refuse, within
from fits_files import write_products
from scipy import linalg, stats

import lusee_bayes as lb
from lusee_bayes.experiment.data_files import digest_of, items_of
from lusee_bayes.experiment.model import full_model, set_up, simulate
from lusee_bayes.instrument import schedule, waterfalls
from lusee_bayes.instrument.averaging import averaged
from lusee_bayes.instrument.visibilities import read_visibilities
from lusee_bayes.linear.linear_gaussian import Form, form_of
from lusee_bayes.runs.cost import posterior_cost, simulation_cost
from lusee_bayes.runs.plan_run import default_variations, expected_inference, forecast
from lusee_bayes.testing import assert_refused, small_scenario

STEP = 7200.0
# from the stamps to the beginning of the windows
TO_START = {"start": 0.0, "middle": -0.5, "end": -1.0}


def file_of(folder, window):
    """Of samples with windows or instants; of neither, where ``window`` is None."""
    observation = lb.Observation.from_runs([lb.Run(0.02)], window=window or "instant")
    data = np.random.default_rng(2).normal(3e4, 1e2, (observation.n_times, 16))
    stamp = "instant" if window != "mean" else "middle"
    made = lb.Visibilities.from_arrays(data, observation.times, 25.0, timestamp=stamp)
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
        found = lb.read_data(given, scenario())
        assert found.digest() == read.digest() == digest_of(found)
    other = replace(read, frequency_mhz=30.0)
    assert lb.read_data([read, other], scenario("frequency_mhz=30")).frequency_mhz == 30.0
    # of files, only that at the frequency is read
    other.write(tmp_path / "other.nc")
    with h5py.File(tmp_path / "other.nc", "a") as file:
        file["visibility"][:] = np.nan
    both = [path, tmp_path / "other.nc"]
    assert lb.read_data(both, scenario()).digest() == read.digest()
    refuse("visibility", lb.read_data, both, scenario("frequency_mhz=30"))
    averages = lb.read_data(read, scenario(f"observation.average_s={2 * STEP}"))
    assert averages.digest() == averaged(read, 2 * STEP).digest()
    for given, noun in (
        ([read, other], "none of them at 20 MHz"),
        ([read, path], "both in memory and in files"),
        ([], "no data"),
    ):
        refuse(noun, lb.read_data, given, scenario("frequency_mhz=20"))
    for given in (np.zeros(3), [3.0]):
        assert_refused(lambda given=given: items_of(given))


def test_a_truth_of_another_lmax_is_cut_or_filled():
    """Data that are simulated at one lmax and mapped at others."""
    made = lb.build(scenario()).data
    for lmax in (1, 2, 4):
        truth = lb.build(small_scenario(lmax=lmax, cycles=0.02), made).data.truth
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
        found = lb.read_data(path, given).observation
        start = (found.times - stamps.times).sec + found.windows.bounds_s[:, 0]
        # Julian dates in two parts
        within(start, TO_START[timestamp] * STEP, 1e-6)
        within(found.live_s, STEP, 1e-6)
    instants = lb.read_data(path, scenario("observation.timestamp=instant"))
    assert instants.observation.windows is None and instants.says_window


@pytest.mark.parametrize("window", ["mean", "instant"])
def test_a_file_that_says_it_is_believed_whatever_is_simulated(tmp_path, window):
    path, _ = file_of(tmp_path, window)
    agreeing = "middle" if window == "mean" else "instant"
    for more in ([], ["observation.window=instant"], [f"observation.timestamp={agreeing}"]):
        found = lb.read_data(path, scenario(*more))
        assert (found.observation.windows is None) == (window == "instant")


UNCLEAR = [
    (None, None, r"use --set observation.timestamp=start \(or middle, end, instant\)"),
    ("instant", "start", "declares its samples instants, but the scenario"),
    ("mean", "start", "declares its samples means over windows"),
    ("mean", "instant", "observation.timestamp=instant; remove that"),
]


@pytest.mark.parametrize(("window", "timestamp", "words"), UNCLEAR)
def test_what_is_unclear_or_contradicts_is_refused(tmp_path, window, timestamp, words):
    path, _ = file_of(tmp_path, window)
    given = [] if timestamp is None else [f"observation.timestamp={timestamp}"]
    refuse(f"^{path}.*{words}", lb.read_data, path, scenario(*given))


def test_no_experiment_of_data_with_unclear_times_or_a_fixed_axis_in_windows(tmp_path):
    data = read_visibilities(file_of(tmp_path, None)[0])
    refuse(r"times.*data\.stamped", set_up, scenario(), data)
    data, fixed = read_visibilities(file_of(tmp_path, "mean")[0]), "observation.fixed_axis=true"
    refuse("means over windows.*remove observation.fixed_axis", set_up, scenario(fixed), data)


def test_waterfalls_are_instants_unless_the_scenario_says_other(tmp_path):
    path = write_products(tmp_path / "w.fits", np.full((12, 16, 1), 3e4), frequencies=(25.0,))
    found = lb.read_data(path, scenario())
    assert found.observation.windows is None and found.says_window
    started = lb.read_data(path, scenario("observation.timestamp=start")).observation
    within((started.times - found.observation.times).sec, STEP / 2, 1e-6)
    np.testing.assert_allclose(started.windows.bounds_s, [[-STEP / 2, STEP / 2]] * 12)
    assert lb.read_data(path, scenario("observation.timestamp=instant")).digest() == found.digest()
    average = scenario("observation.average_s=14400")
    refuse("w.fits: the samples are instants", lb.read_data, path, average)


def test_waterfalls_have_no_room_for_windows(tmp_path):
    data = lb.build(scenario("observation.window=mean")).data
    words = r"hold instants.*observation\.window=instant"
    refuse(words, waterfalls.write_waterfall, tmp_path / "w.fits", 2 * [data])
    assert not list(tmp_path.iterdir())


STEP_S = 20000.0
TABLE = """\
start,end,turntable_deg,duty_cycle
2027-01-15,2027-01-18,0,0.5
2027-01-18T00:30:00,2027-01-20,30,0.5
2027-02-14,2027-02-19T12:00:00,30,1
"""


@pytest.fixture
def path(write):
    return write(TABLE, "nights.csv")


@pytest.fixture
def given(path):
    return ["lmax=4", f"observation={{schedule: {path}, step_s: {STEP_S}, window: mean}}"]


def test_a_schedule_is_simulated_and_mapped(path, given, tmp_path):
    scenario = lb.load_scenario("fiducial", given)
    observation = scenario.observation.observation()
    expected = lb.Observation.from_schedule(schedule.read_schedule(path), step_s=STEP_S)
    np.testing.assert_array_equal(observation.times.jd, expected.times.jd)
    np.testing.assert_array_equal(observation.live_s, expected.live_s)
    # 3 days, 47.5 hours and 5.5 days in steps of 20000 s: 13, 9 and 24 of them
    assert (observation.n_times, observation.turntable_deg) == (46, (0.0, 30.0))
    (simulated,) = lb.run_simulate(scenario, tmp_path / "data.nc")
    assert simulated.observation.n_times == 46
    experiment = lb.build(scenario)
    np.testing.assert_array_equal(experiment.data.observation.run, expected.run)
    posterior = lb.infer(experiment).posterior
    error = np.asarray(posterior.mean - experiment.setup.sky.modes)
    # 25 modes: their chi^2 is not above 60 once in 1e4 schedules
    assert error @ np.linalg.solve(np.asarray(posterior.covariance()), error) < 60.0


def test_costs_count_the_samples_of_a_schedule(given):
    scenario = lb.load_scenario("fiducial", given)
    n_data = 16 * scenario.observation.observation().n_times
    assert simulation_cost(scenario).n_data == n_data
    assert posterior_cost(scenario).n_data == n_data
    runs = lb.load_scenario("fiducial", ["observation.step_s=7200"])
    assert simulation_cost(runs).n_data == 16 * runs.observation.observation().n_times


def test_a_plan_keeps_the_dates_of_a_schedule(given):
    scenario = lb.load_scenario("fiducial", given)
    variations = default_variations("fiducial", scenario)
    assert {v.family for v in variations} == {"as given", "duty cycle", "antenna lost"}
    assert all(v.scenario.observation == scenario.observation for v in variations)
    # 3 days and 47.5 hours at half duty, and 5.5 days
    assert forecast(variations[0]).days == pytest.approx((3.0 + 47.5 / 24.0) / 2.0 + 5.5, abs=1e-9)


def test_what_is_wrong_with_the_file_is_said(given, path):
    path.write_text(TABLE.replace("2027-01-18,", "2028-01-18,"))
    scenario = lb.load_scenario("fiducial", given)
    refuse(r"nights\.csv, row 2.*interval.*begins", lb.build, scenario)
    path.unlink()
    refuse("no schedule.*CSV.* at '", posterior_cost, scenario)


DRAWS = 12
HOUR = 3600.0


class Map(NamedTuple):
    """A model, what solves it for any data, and what the planner says of its information."""

    model: lb.LinearGaussian
    form: Form
    bits: float

    @classmethod
    def of(cls, scenario, data, observation):
        setup = set_up(scenario, replace(data, observation=observation))
        bits = float(expected_inference(setup).posterior.information_bits())
        model = full_model(setup)
        return cls(model, form_of(model).of(model), bits)

    def covariance(self):
        return np.asarray(self.form.condition(np.zeros(self.model.n_data)).covariance)


class Maps(NamedTuple):
    """Maps of fine samples (as instants), of averages, and of of averages taken for instants."""

    samples: lb.Visibilities
    to_s: float
    fine: Map
    windows: Map
    instants: Map

    def averaged(self, values):
        return averaged(replace(self.samples, data=np.asarray(values)), self.to_s)


@pytest.fixture(scope="module", params=[pytest.param(2, marks=pytest.mark.long), 12])
def maps(request):
    """Of 60 s, averaged over so many hours."""
    overrides = ["lmax=8", "observation.step_s=60", "observation.window=mean"]
    scenario = lb.load_scenario("fiducial", [*overrides, "observation.runs.0.cycles=0.1"])
    samples, to_s = simulate(set_up(scenario)), request.param * HOUR
    coarse = averaged(samples, to_s)
    fine = Map.of(scenario, samples, replace(samples.observation, windows=None))
    windows = Map.of(scenario, coarse, coarse.observation)
    instants = Map.of(scenario, coarse, replace(coarse.observation, windows=None))
    return Maps(samples, to_s, fine, windows, instants)


def test_as_much_is_lost_as_the_planner_says(maps):
    ratios = linalg.eigh(maps.windows.covariance(), maps.fine.covariance(), eigvals_only=True)
    # N of averages has the squares of mean autos, which are smaller than the mean squares
    noise = maps.averaged(maps.fine.model.noise.diagonal())
    samples = noise.observation.live_s[noise.layout.time] / maps.samples.observation.step_s
    too_small = 1.0 - np.asarray(maps.windows.model.noise.diagonal()) / (noise.data / samples)
    assert 0.0 < too_small.max() < 2e-3
    # and of the finest structure A leaves out up to 1e-5 of what little it adds
    assert ratios.min() > 1.0 - too_small.max() - 2e-5
    lost = 0.5 * np.log2(ratios).sum()
    assert maps.fine.bits - maps.windows.bits == pytest.approx(lost, abs=1e-3)
    assert 0.1 < lost < 0.02 * maps.fine.bits


def test_maps_of_averages_are_right_and_of_instants_wrong(maps):
    """Skies of the prior, their fine samples with noise, and the averages of these."""
    rng, model, off = np.random.default_rng(3), maps.fine.model, []
    std = np.sqrt(np.asarray(model.noise.diagonal()))
    for _ in range(DRAWS):
        sky = np.asarray(model.prior.colour(rng.standard_normal(model.prior.size)))
        fine = np.asarray(model.coupling @ sky) + std * rng.standard_normal(len(std))
        coarse = maps.averaged(fine).data
        right, wrong = (one.form.condition(coarse) for one in (maps.windows, maps.instants))
        squares = [(one.posterior.whiten(sky[None]) ** 2).sum() for one in (right, wrong)]
        off.append([*squares, right.chi2])
    right, wrong, misfit = np.sum(off, axis=0)
    low, high = stats.chi2(DRAWS * len(sky)).interval(1 - 1e-4)
    assert low < right < high < wrong
    low, high = stats.chi2(DRAWS * maps.windows.model.n_data).interval(1 - 1e-4)
    assert low < misfit < high
