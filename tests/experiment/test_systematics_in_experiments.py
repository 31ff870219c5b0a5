"""Systematics from scenario to map: marginalised they cost little, ignored they ruin everything."""

from dataclasses import replace
from functools import lru_cache

import jax.numpy as jnp
import numpy as np
import pytest
from assertions import within
from experiments import small_experiment

import lusee_bayes as lb
from lusee_bayes.experiment import model as models
from lusee_bayes.experiment.experiment import Experiment
from lusee_bayes.experiment.model import full_model, radiometer, true_values
from lusee_bayes.experiment.rounds import SETTLED, Inference, prediction
from lusee_bayes.noise.covariance import LowRankUpdate
from lusee_bayes.systematics.beam import beam_rms_difference, difference_of_beams
from lusee_bayes.systematics.context import Around

GAIN = "noise.gain.sigma=0.01"
SHIFT = "noise.beam.shift_mhz=4"
PARAMETERS = "noise.beam.parameters={length_m: 0.1, zenith_angle_deg: 2.0}"


def experiment(*overrides: str) -> Experiment:
    return small_experiment(*overrides, cycles=0.2)


@lru_cache
def inferred(*overrides: str) -> Inference:
    return lb.infer(experiment(*overrides))


# --- what the gain term is built around -------------------------------------------------------


@pytest.mark.long
def test_the_posteriors_own_prediction_has_settled():
    e, found = (f(GAIN, "noise.gain.visibilities=posterior") for f in (experiment, inferred))
    setup, data, posterior = e.setup, e.data, found.posterior
    assert 2 <= found.rounds <= 10
    predicted = lb.CouplingMatrix.build(setup.beams, setup.pointing) @ posterior.mean
    predicted = predicted.reshape(16, -1)
    # the signal plus A (m - sky) cancels to rounding
    scale = float(jnp.abs(predicted).max())
    within(prediction(setup, found, np.zeros(found.model.n_data)), predicted, 1e-12 * scale)
    gains = {"gains": found.around.gains, "gain_slope": found.around.gain_slope}
    again = full_model(setup, Around(data, predicted, **gains)).condition(data.data).posterior
    assert float(again.rms_shift_from(posterior.mean)) < SETTLED
    # it did move on the way
    measured = inferred(GAIN, "noise.gain.visibilities=measured").posterior
    assert float(posterior.rms_shift_from(measured.mean)) > SETTLED


MOVES = {
    "beam": "noise.beam={parameters: {deep_permittivity: 0.3, zenith_angle_deg: 0.3}}",
    "fields": "noise.fields={}",
    "pointing": "noise.pointing={turntable_deg: 0.5, clock_s: 60}",
    "horizon": "noise.horizon={std_deg: 2, altitude_deg: 3}",
}


@pytest.mark.parametrize("name", MOVES)
def test_the_signal_of_an_instrument_with_other_values_is_its_own(name):
    """A m + background of the moved instrument, with A as rows; and it differs from the first."""
    setup = small_experiment(MOVES[name], lmax=4, cycles=0.05).setup
    there = models.moved(setup, true_values(setup))
    seen = there.coupling.dense() @ there.sky.modes + there.layout.gather(there.background)
    got = np.asarray(there.layout.gather(there.signal))
    within(got, seen, 1e-12 * np.abs(seen).max())
    assert np.abs(got - setup.layout.gather(setup.signal)).max() > 1e-4 * np.abs(seen).max()


@pytest.mark.parametrize("name", MOVES)
def test_the_sky_above_lmax_is_seen_by_the_instrument_with_its_values(name):
    """In N and in simulated data, with A of a scenario that goes as high; and A differs."""
    above = "noise.above_lmax={margin: 3, least_lmax: 0}"
    setup = small_experiment(MOVES[name], above, lmax=4, cycles=0.05).setup
    values = true_values(setup)
    expected = models.moved(small_experiment(MOVES[name], lmax=7, cycles=0.05).setup, values)
    a, n = np.asarray(expected.coupling.dense()), setup.prior.size
    (term,) = (s for _, s in models.systematics(setup, Around(values=values)) if hasattr(s, "root"))
    within(term.root, a[:, n:] @ setup.above.root[n:], 1e-11 * np.abs(term.root).max())
    assert np.abs(term.root - setup.above.seen[0]).max() > 1e-4 * np.abs(term.root).max()
    sky, ends = setup.sky.modes, setup.scenario.with_section("noise", above_lmax=None)
    flat = replace(setup, scenario=ends, above=None)
    whole, below = (models.true_model(one, values).predict(sky) for one in (setup, flat))
    within(np.asarray(whole - below), a[:, n:] @ setup.above.modes, 1e-12 * np.abs(whole).max())


@pytest.mark.essential
def test_gains_are_about_what_antennas_with_found_values_would_see():
    """Their visibilities, times found gains, leave only the noise: 1e-5 of them; with those of the
    expected antennas it is 1e-2."""
    overrides = "noise.gain.sigma=0.005", MOVES["beam"], "prior={model: local_scales}"
    found = inferred(*overrides, "lmax=6")
    (drifts,), data = found.drifts, found.solution.data
    seen = drifts.response(drifts.found) * drifts.layout.gather(drifts.visibilities)
    std = np.sqrt(np.asarray(radiometer(experiment(*overrides, "lmax=6").setup).diagonal()))
    assert 0.5 < float((((data - np.asarray(seen)) / std) ** 2).mean()) < 1.5


# --- beams ------------------------------------------------------------------------------------


@pytest.mark.long
def test_beam_parameters_are_directions_of_one_sigma():
    """About the sky and the values that were found."""
    setup, found = experiment(PARAMETERS).setup, inferred(PARAMETERS)
    expected, values = np.diag(np.asarray(radiometer(setup).diagonal())), found.around.values
    assert isinstance(found.model.noise, LowRankUpdate) and len(values) == 2
    for name, sigma in {"length_m": 0.1, "zenith_angle_deg": 2.0}.items():
        steps = (values | {name: values[name] + step} for step in (1e-4, -1e-4))
        beams = ([f"beam.{key}={value}" for key, value in step.items()] for step in steps)
        plus, minus = (experiment(*one).setup.coupling @ found.around.sky for one in beams)
        moved = sigma * (np.asarray(plus) - np.asarray(minus)) / 2e-4
        expected = expected + np.outer(moved, moved)
    # central differences: h^2 f''' = 1e-8 of the slope
    within(np.asarray(found.model.noise.dense()), expected, 1e-6 * expected.max())
    # the data's own beams differ by a draw of that size
    assert 1e-3 < beam_rms_difference(setup) < 0.3
    assert beam_rms_difference(experiment().setup) is None


def test_a_shifted_beam_is_that_of_the_other_frequency():
    setup, data = experiment(SHIFT).setup, experiment(SHIFT).data
    other = lb.monopole_beams(29.0, 6)
    # the same beams compiled twice: rounding
    within(models.moved(setup, models.true_values(setup)).beams.modes, other.modes, 1e-15)
    change = np.asarray(other.modes) - np.asarray(setup.beams.modes)
    within(difference_of_beams(setup.scenario.noise.beam, setup, {}), change, 1e-15)
    seen = lb.CouplingMatrix.build(other, setup.pointing) @ setup.sky.modes
    z = np.asarray(data.data - seen) / np.sqrt(np.asarray(radiometer(setup).diagonal()))
    assert abs((z**2).sum() - z.size) < 5 * np.sqrt(2 * z.size)
