"""What is marginalised is the derivative of the function that is sampled: against differences."""

from __future__ import annotations

import numpy as np
import pytest

import lusee_bayes as lb
from lusee_bayes.core.arrays import on_host
from lusee_bayes.experiment.model import base_model, moved, set_up, systematics
from lusee_bayes.experiment.scenario import Scenario
from lusee_bayes.instrument.pointing import CLOCK
from lusee_bayes.systematics.context import Around
from lusee_bayes.systematics.systematic import Expanded

RUNS = "observation.runs=[{cycles: 0.2}, {cycles: 0.2, turntable_deg: 30}]"
POINTING = (
    "noise.pointing={clock_s: 60, clock_drift_s_per_day: 20, turntable_deg: 0.3, lon_deg: 0.1, "
    "lat_deg: 0.1, tilt_east_deg: 0.2, tilt_north_deg: 0.1}"
)
SOURCES = ["sky.sources=false", "sources.list=[{name: Cas A}, {name: Cyg A, stokes_v: 0.3}]"]
TABLE = ["noise.receiver={power_k: 500}", "noise.gain_table={std: 0.02}"]
OTHERS = [*TABLE, "sources.list=[{name: Cas A, block_h: 50}]", "sky.sources=false"]


def scenario(*more: str) -> Scenario:
    given = ["lmax=5", "observation.step_s=43200", RUNS, *more]
    return lb.load_scenario("fiducial", [*given, "prior={model: isotropic, spectrum: sky}"])


def differences(systematic, model, sky, centre):
    """Central ones of the effect, with steps of 1e-4 prior standard deviations."""

    def seen(z):
        return np.asarray(systematic.effect(model, systematic.values(z)).predict(sky))

    steps = 1e-4 * np.eye(len(centre))
    return np.stack([(seen(centre + s) - seen(centre - s)) / 2e-4 for s in steps], axis=1)


BESIDE_SOURCES = pytest.param([POINTING, *SOURCES], marks=pytest.mark.long)


@pytest.mark.parametrize("more", [OTHERS, [POINTING], BESIDE_SOURCES])
def test_columns_are_the_derivative_of_the_effect(more):
    """Away from the prior means. Differences are good to rounding over the step, 1e-16 / 1e-4 of
    data that are 1e3 times what a standard deviation does; a clock's drift turns the Moon about its
    z axis there and about the mean pole here, 0.04 degrees apart."""
    setup = set_up(scenario(*more))
    rng, values = np.random.default_rng(0), {}
    for _, systematic in systematics(setup):
        values |= systematic.in_units(rng.normal(size=len(systematic.names)))
    model, sky = base_model(setup), setup.sky.modes
    for _, systematic in systematics(setup, Around(values=values)):
        expanded = on_host(Expanded.about(systematic, model, sky, values))
        expected = differences(systematic, model, sky, expanded.centre)
        size, off = (np.linalg.norm(x, axis=0) for x in (expected, expanded.columns - expected))
        for name, size_of, off_of in zip(systematic.names, size, off, strict=True):
            # a source that is down in a block does nothing
            assert size_of > 0.0 or name.startswith("flux_")
            assert off_of <= (1e-3 if "drift" in name else 1e-6) * size_of


def test_about_values_a_is_that_of_the_shifted_observation():
    setup = set_up(scenario(POINTING, *SOURCES))
    (_, nominal), *_ = systematics(setup)
    values = nominal.in_units(np.random.default_rng(1).normal(size=len(nominal.names)))
    (_, offsets), *_ = systematics(setup, Around(values=values))
    model, sky = base_model(setup), setup.sky.modes
    got = np.asarray(offsets.effect(model, values).predict(sky))
    exact = np.asarray(moved(setup, values).coupling @ sky)
    np.testing.assert_allclose(got, exact, rtol=0, atol=1e-12 * np.abs(exact).max())
    # sources that the context has moved are not moved twice, and angles alone need no ephemeris
    angles = {name: value for name, value in values.items() if name not in CLOCK}
    got = np.asarray(nominal.effect(model, dict.fromkeys(CLOCK, 0.0) | angles).predict(sky))
    there = moved(setup, angles)
    exact = np.asarray(there.coupling @ sky)
    change = np.array(there.responses) - np.array(setup.responses)
    for section, seen in zip(setup.scenario.sources.list, change, strict=True):
        exact = exact + section.mean_flux(25.0) * setup.layout.gather(seen)
    np.testing.assert_allclose(got, exact, rtol=0, atol=1e-9 * np.abs(exact).max())
