"""Scenarios whose observation is a schedule."""

import numpy as np
import pytest

from lusee_bayes.core.errors import InputError
from lusee_bayes.experiment.experiment import build, infer
from lusee_bayes.experiment.scenario import load_scenario
from lusee_bayes.instrument.observation import Observation
from lusee_bayes.instrument.schedule import read_schedule
from lusee_bayes.runs.cost import posterior_cost, simulation_cost
from lusee_bayes.runs.data_run import run_simulate
from lusee_bayes.runs.forecasting import default_variations, forecast

STEP_S = 20000.0
TABLE = """\
start,end,turntable_deg,duty_cycle
2027-01-15,2027-01-18,0,0.5
2027-01-18T00:30:00,2027-01-20,30,0.5
2027-02-14,2027-02-19T12:00:00,30,1
"""


@pytest.fixture
def path(tmp_path):
    path = tmp_path / "nights.csv"
    path.write_text(TABLE)
    return path


@pytest.fixture
def given(path):
    values = {"schedule": path, "step_s": STEP_S, "window": "mean"}
    return ["lmax=4", *(f"observation.{name}={value}" for name, value in values.items())]


def test_a_schedule_is_simulated_and_mapped(path, given, tmp_path):
    scenario = load_scenario("fiducial", given)
    observation = scenario.observation.observation()
    expected = Observation.from_schedule(read_schedule(path), step_s=STEP_S)
    np.testing.assert_array_equal(observation.times.jd, expected.times.jd)
    np.testing.assert_array_equal(observation.live_s, expected.live_s)
    # 3 days, 47.5 hours and 5.5 days in steps of 20000 s: 13, 9 and 24 of them
    assert (observation.n_times, observation.turntable_deg) == (46, (0.0, 30.0))
    (simulated,) = run_simulate(scenario, tmp_path / "data.nc")
    assert simulated.observation.n_times == 46
    experiment = build(scenario)
    np.testing.assert_array_equal(experiment.data.observation.run, expected.run)
    posterior = infer(experiment).posterior
    error = np.asarray(posterior.mean - experiment.setup.sky.modes)
    # 25 modes: their chi^2 is not above 60 once in 1e4 schedules
    covariance = np.asarray(posterior.covariance())
    assert error @ np.linalg.solve(covariance, error) < 60.0


def test_costs_count_the_samples_of_a_schedule(given):
    scenario = load_scenario("fiducial", given)
    n_data = 16 * scenario.observation.observation().n_times
    assert simulation_cost(scenario).n_data == n_data
    assert posterior_cost(scenario).n_data == n_data
    runs = load_scenario("fiducial", ["observation.step_s=7200"])
    assert simulation_cost(runs).n_data == 16 * runs.observation.observation().n_times


def test_a_plan_keeps_the_dates_of_a_schedule(given):
    scenario = load_scenario("fiducial", given)
    variations = default_variations("fiducial", scenario)
    assert {v.family for v in variations} == {"as given", "duty cycle", "antenna lost"}
    assert all(v.scenario.observation == scenario.observation for v in variations)
    # 3 days and 47.5 hours at half duty, and 5.5 days
    live = (3.0 + 47.5 / 24.0) / 2.0 + 5.5
    assert forecast(variations[0]).days == pytest.approx(live, abs=1e-9)


def test_half_duty_in_the_schedule_is_half_duty_of_the_receivers(given, path):
    """Live time is what noise goes by, whoever says that it is half of the time."""
    header, *rows = TABLE.splitlines()
    said = {}
    for duty, of_receivers in (("0.5", 1.0), ("1", 0.5)):
        lines = [f"{row.rpartition(',')[0]},{duty}" for row in rows]
        path.write_text("\n".join([header, *lines]))
        overrides = [*given, f"noise.radiometer.duty_cycle={of_receivers}"]
        scenario = load_scenario("fiducial", overrides)
        said[duty] = forecast(default_variations("fiducial", scenario)[0])
    # the same numbers but for products of 0.5, which are exact
    assert said["0.5"].information_bits == pytest.approx(said["1"].information_bits, rel=1e-9)
    assert said["1"].days == pytest.approx(2.0 * said["0.5"].days, rel=1e-12)


def test_what_is_wrong_with_the_file_is_said(given, path):
    path.write_text(TABLE.replace("2027-01-18,", "2028-01-18,"))
    with pytest.raises(InputError, match=r"nights.csv, row 2: the interval from .* begins"):
        build(load_scenario("fiducial", given))
    path.unlink()
    with pytest.raises(InputError, match="no schedule, a table in CSV or .* at '"):
        posterior_cost(load_scenario("fiducial", given))
