"""Receivers' noise and the ground's temperature: templates of N, or sites, against matrices."""

from __future__ import annotations

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
from closeness import within
from experiments import four_ports, program_arguments
from numpyro.infer.util import log_density
from reference_linear import white_posterior
from scipy.stats import norm

import lusee_bayes as lb
from lusee_bayes.experiment.model import full_model, radiometer
from lusee_bayes.experiment.setup import set_up
from lusee_bayes.experiment.simulate import simulate, true_signal, true_values
from lusee_bayes.instrument.products import labels
from lusee_bayes.linear.templates import template_amplitudes
from lusee_bayes.sampling.promotion import numpyro_promotion
from lusee_bayes.testing import small_scenario

RECEIVER = "noise.receiver={power_k: 2000, relative_std: 0.1, treatment: %s}"
GROUND = "noise.regolith={std_k: 30, treatment: %s}"
AUTOS = [labels().index(f"{port}{port}R") for port in range(4)]


@pytest.fixture(scope="module")
def experiment(response_file) -> lb.Experiment:
    return lb.build(four_ports(response_file, RECEIVER % "marginalised", GROUND % "marginalised"))


def columns(response_file, n_times: int) -> np.ndarray:
    """What one standard deviation of each of the five adds to the data, made by hand."""
    grid = np.zeros((16, n_times, 5))
    for port, product in enumerate(AUTOS):
        grid[product, :, port] = 200.0
    response = lb.read_beam(response_file)
    warmer = response.background(20.0, 280.0) - response.background(20.0, 250.0)
    grid[:, :, 4] = warmer[:, None]
    return grid.reshape(-1, 5)


def joint(experiment: lb.Experiment, response_file):
    """Sky and the five together: 21 unknowns with independent priors."""
    setup, data = experiment.setup, np.asarray(experiment.data.data)
    t = columns(response_file, setup.layout.n_times)
    a = np.concatenate([np.asarray(setup.coupling.dense()), t], axis=1)
    prior = np.append(np.sqrt(np.asarray(setup.prior.variance())), np.ones(5))
    constant = np.asarray(lb.read_beam(response_file).background(20.0, 250.0)).copy()
    constant[AUTOS] += 2000.0
    noise = np.sqrt(np.asarray(radiometer(setup).diagonal()))
    rest = data - np.repeat(constant, setup.layout.n_times)
    return white_posterior(a, prior, noise, rest)


def test_marginalised_they_are_the_closed_form(experiment, response_file):
    """Means to 1e-5 standard deviations, covariances to 1e-5: Lambda's condition costs 1e-6."""
    found, expected = lb.infer(experiment), joint(experiment, response_file)
    std, sky = expected.std, slice(16)
    off = (np.asarray(found.posterior.mean) - expected.mean[sky]) / std[sky]
    assert np.abs(off).max() < 1e-5
    scale = np.outer(std, std)
    got = np.asarray(found.posterior.covariance())
    within(got / scale[sky, sky], expected.covariance[sky, sky] / scale[sky, sky], 1e-5)
    assert float(found.posterior.log_evidence) == pytest.approx(expected.log_prob, abs=1e-4)
    t = np.concatenate([np.asarray(s.columns) for s in found.systematics], axis=1)
    told = template_amplitudes(found.model, found.posterior, experiment.data.data, t)
    assert np.abs((told.mean - expected.mean[16:]) / std[16:]).max() < 1e-5
    blocks = [(told.covariance, slice(16, 21), slice(16, 21)), (told.with_sky, sky, slice(16, 21))]
    for block, rows, cols in blocks:
        wanted = expected.covariance[rows, cols] / scale[rows, cols]
        within(block / scale[rows, cols], wanted, 1e-5)
    # sky and unknowns do depend on one another, and the data do tell the receivers
    assert np.abs(expected.covariance[0, 16:] / scale[0, 16:]).max() > 0.05
    assert (std[16:20] < 0.5).all()


def test_the_mean_receiver_sets_the_noise_and_the_offset(experiment, response_file):
    bare = set_up(four_ports(response_file))
    setup = experiment.setup
    added = np.asarray(setup.signal) - np.asarray(bare.signal)
    np.testing.assert_allclose(added[AUTOS], 2000.0, rtol=1e-9)
    np.testing.assert_allclose(np.delete(added, AUTOS, axis=0), 0.0, atol=1e-9)
    ratio = np.asarray(radiometer(setup).diagonal()) / np.asarray(radiometer(bare).diagonal())
    assert ratio.reshape(16, -1)[0].min() > 1.2
    np.testing.assert_allclose(setup.offset - bare.offset, setup.layout.gather(added), atol=1e-8)


def test_powers_in_volts_and_their_slope(response_file):
    """P / U_aa at the receiver's input, and a power law in frequency: (20 / 5)^-2 = 1/16."""
    per_kelvin = lb.read_beam(response_file).per_kelvin(20.0)
    keys = "slope: -2, reference_mhz: 5"
    volts = set_up(four_ports(response_file, f"noise.receiver={{power_v2_hz: 1e-17, {keys}}}"))
    ground = lb.read_beam(response_file).background(20.0, 250.0)[AUTOS]
    np.testing.assert_allclose(volts.background[AUTOS] - ground, 1e-17 / 16 / per_kelvin, rtol=1e-9)
    kelvin = set_up(four_ports(response_file, f"noise.receiver={{power_k: 160, {keys}}}"))
    np.testing.assert_allclose(kelvin.background[AUTOS] - ground, 10.0, rtol=1e-9)


def test_receivers_of_antennas_that_know_no_volts():
    setup = set_up(small_scenario("noise.receiver={power_k: 100}"))
    assert setup.offset is not None
    np.testing.assert_array_equal(setup.background[AUTOS], 100.0)


@pytest.mark.parametrize("treatment", ["marginalised", "sampled", "ignored"])
def test_simulated_data_hold_them_whatever_their_treatment(experiment, response_file, treatment):
    given = four_ports(response_file, RECEIVER % treatment, GROUND % treatment)
    setup = replace(experiment.setup, scenario=given)
    truth = true_values(setup)
    assert set(truth) == {*(f"receiver_{port}_k" for port in range(4)), "regolith_k"}
    powers = np.array([truth[f"receiver_{port}_k"] for port in range(4)])
    # drawn from their priors, each its own
    assert (np.abs(powers - 2000.0) < 4 * 200.0).all()
    assert len(set(powers)) == 4
    assert 0.0 < abs(truth["regolith_k"] - 250.0) < 4 * 30.0
    z = np.append((powers - 2000.0) / 200.0, (truth["regolith_k"] - 250.0) / 30.0)
    added = np.asarray(setup.layout.gather(true_signal(setup, truth) - setup.signal))
    t = columns(response_file, setup.layout.n_times)
    np.testing.assert_allclose(added, t @ z, rtol=0, atol=1e-8)
    np.testing.assert_array_equal(simulate(setup).data, experiment.data.data)
    reseeded = replace(setup, scenario=given.model_copy(update={"seed": 2}))
    assert not set(true_values(reseeded).values()) & set(truth.values())


def test_ignored_they_are_taken_for_their_means(experiment, response_file):
    given = four_ports(response_file, RECEIVER % "ignored", GROUND % "ignored")
    setup = replace(experiment.setup, scenario=given)
    found = full_model(setup)
    np.testing.assert_array_equal(found.noise.diagonal(), radiometer(setup).diagonal())
    np.testing.assert_array_equal(found.offset, setup.offset)
    # which the data contradict: a receiver off by 200 K is hundreds of standard deviations
    chi2 = found.chi2(found.condition(experiment.data.data).mean, experiment.data.data)
    assert float(chi2) > 100 * found.n_data


def test_ground_at_zero_kelvin_has_a_template_all_the_same(response_file):
    cold = set_up(four_ports(response_file, "beam.moon_temperature_k=0", GROUND % "marginalised"))
    assert cold.offset is None
    root = columns(response_file, cold.layout.n_times)[:, 4:]
    bare = np.diag(np.asarray(radiometer(cold).diagonal()))
    np.testing.assert_allclose(full_model(cold).noise.dense(), bare + root @ root.T, rtol=1e-6)


def test_sampled_the_density_is_the_closed_form(response_file):
    """Priors by scipy, and the evidence of the sky alone given the five."""
    given = four_ports(response_file, RECEIVER % "sampled", GROUND % "sampled")
    e = lb.build(given)
    setup, z = e.setup, np.array([0.3, -0.2, 0.1, 0.5, -1.2])
    values = {f"receiver_{port}_k": 2000.0 + 200.0 * z[port] for port in range(4)}
    values["regolith_k"] = 250.0 + 30.0 * z[4]
    program = lb.load_program("systematics")
    sites = {name: jnp.asarray(value) for name, value in values.items()}
    with numpyro_promotion():
        got, trace = log_density(program.model, (), program_arguments(program, e), sites)
    assert set(trace) == {*values, "data"}
    t = columns(response_file, setup.layout.n_times)
    rest = np.asarray(e.data.data) - np.asarray(setup.offset) - t @ z
    prior = np.sqrt(np.asarray(setup.prior.variance()))
    noise = np.sqrt(np.asarray(radiometer(setup).diagonal()))
    a = np.asarray(setup.coupling.dense())
    expected = white_posterior(a, prior, noise, rest).log_prob
    expected += norm.logpdf(z).sum() - 4 * np.log(200.0) - np.log(30.0)
    # chi^2 of 1e7, each of whose squares is right to 1e-10 of itself
    assert float(got) == pytest.approx(expected, rel=1e-8)


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["noise.receiver={}"], "give either power_v2_hz or power_k"),
        (["noise.receiver={power_k: 1, power_v2_hz: 1e-17}"], "give either power_v2_hz or power_k"),
        (["noise.receiver={power_k: 1, relative_std: 0}"], "greater than 0"),
        (["noise.regolith={}"], "std_k"),
        (["noise.receiver={power_v2_hz: 1e-17}"], r"power_v2_hz needs antennas that know volts"),
        (["noise.regolith={std_k: 30}"], r"noise\.regolith needs antennas that receive from the"),
    ],
)
def test_refused_in_one_sentence(overrides, message):
    with pytest.raises(lb.InputError, match=message) as caught:
        set_up(lb.load_scenario("fiducial", ["lmax=2", "observation.step_s=1e5", *overrides]))
    assert "\n" not in str(caught.value)
