"""What a run is expected to take: more of everything takes more; what does not fit is refused."""

import pytest
from assertions import refuse

import lusee_bayes as lb
from lusee_bayes.results.forecast import AS_GIVEN, Variation
from lusee_bayes.runs import cost

SOURCES = "sources.list=[{name: Cas A}, {name: Cyg A}]"


def cost_of(*overrides):
    return cost.posterior_cost(lb.load_scenario("fiducial", ["lmax=8", *overrides]))


MORE = ["observation.step_s=600", "frequencies_mhz=[20, 25]", SOURCES, "noise.fields={lmax: 2}"]


@pytest.mark.parametrize("more", MORE)
def test_more_of_everything_costs_time_and_memory(more, monkeypatch):
    monkeypatch.setattr(cost, "_operations_a_second", lambda: 1e9)
    one, other = cost_of(), cost_of(more)
    assert other.memory > one.memory and other.seconds > one.seconds


def test_a_plan_that_does_not_fit_is_refused_before_it_starts(tmp_path, monkeypatch):
    monkeypatch.setattr(cost, "memory_limit", lambda: 8e9)
    scenario = lb.load_scenario("fiducial", ["lmax=383"])
    variation = Variation("fiducial", AS_GIVEN, AS_GIVEN, scenario)
    refuse("memory", lb.run_plan, [variation], tmp_path / "plan")
    assert not (tmp_path / "plan").exists()


def test_a_joint_posterior_that_does_not_fit_is_refused_with_what_would(monkeypatch):
    frequencies = "frequencies_mhz=[10,15,20,25,30]"
    scenario = lb.load_scenario("fiducial", ["lmax=100", frequencies, "joint=true"])
    found = cost.posterior_cost(scenario)
    assert found.n_unknowns == 3 * 101**2 and found.memory > 8.0 * 4 * found.n_unknowns**2
    monkeypatch.setattr(cost, "memory_limit", lambda: 16e9)
    refused = r"30,603 unknowns; this process is limited to 16 GB; joint=false would fit"
    refuse(refused, cost.require_fits, found, scenario)
    monkeypatch.setattr(cost, "memory_limit", lambda: 3e9)
    refuse(r"3 GB.*lmax=\d\d\b", cost.require_fits, found, scenario)
