"""The sky above lmax: against the posterior of all modes, and skies that do not end at lmax."""

from dataclasses import replace
from unittest.mock import Mock

import numpy as np
import pytest

import lusee_bayes as lb
from lusee_bayes.core import harmonics, linalg
from lusee_bayes.experiment.experiment import observed
from lusee_bayes.experiment.model import full_model, radiometer, set_up, simulate, true_signal
from lusee_bayes.instrument.visibilities import read_visibilities
from lusee_bayes.systematics import above_lmax, context

LMAX, MARGIN, N = 5, 4, 36
RUNS = "observation={runs: [{cycles: 0.3}], step_s: 14400}"
SHARED = RUNS, "noise.radiometer.temperature=model"


def scenario(lmax, *more):
    return lb.load_scenario("fiducial", [f"lmax={lmax}", *SHARED, *more])


@pytest.fixture(scope="module", params=["isotropic, spectrum: sky", "local_scales"])
def both(request):
    """(scenario to lmax with what is above, setup of all modes)."""
    prior = f"prior={{model: {request.param}}}"
    own = scenario(LMAX, prior, f"noise.above_lmax={{margin: {MARGIN}, least_lmax: 0}}")
    return own, set_up(scenario(LMAX + MARGIN, prior))


def test_integrated_out_is_the_marginal_of_the_posterior_of_all_modes(both, monkeypatch):
    """Of a prior in which those above lmax are not correlated with the others."""
    monkeypatch.setattr(above_lmax, "LEFT_OUT", 1e-16)
    own, whole = both
    data = simulate(whole).with_truth_up_to(LMAX)
    setup = set_up(own, data)
    a, n = np.asarray(whole.coupling.dense()), np.asarray(radiometer(setup).diagonal())
    prior = context.prior_and_family(whole.scenario, whole.sky)[0]
    s = np.array(prior.covariance())
    mean = np.zeros(len(s)) if prior.mean is None else np.asarray(prior.mean)
    s[:N, :N], s[:N, N:], s[N:, :N] = np.asarray(setup.prior.covariance()), 0.0, 0.0
    # least squares of data and prior in white units: no matrix is squared
    rows = np.concatenate([a / np.sqrt(n)[:, None], np.linalg.inv(np.linalg.cholesky(s))])
    q, r = np.linalg.qr(rows)
    white = np.concatenate([(data.data - a @ mean) / np.sqrt(n), np.zeros(len(s))])
    root = np.linalg.inv(r)
    expected, std = mean + root @ (q.T @ white), np.sqrt((root**2).sum(1))
    posterior = full_model(setup).condition(data.data).posterior
    # N is inverted with columns of up to 1e5 times the noise: 1e-16 x (1e5)^2 is lost
    assert np.abs((posterior.mean - expected[:N]) / std[:N]).max() < 1e-3
    np.testing.assert_allclose(posterior.std(), std[:N], rtol=1e-4)


def test_a_file_of_simulated_data_says_that_the_sky_does_not_end_at_lmax(both, tmp_path):
    lb.run_simulate(both[0], tmp_path / "data.nc")
    data = read_visibilities(tmp_path / "data.nc")
    assert len(data.truth) == harmonics.n_modes(LMAX + MARGIN)
    seen = observed(both[0], data)
    assert seen.scenario.noise.above_lmax is not None and len(seen.data.truth) == N


def test_simulated_data_hold_what_the_sky_has_above_lmax(both):
    own, whole = both
    setup, ends_at_lmax = set_up(own), set_up(own.with_section("noise", above_lmax=None))
    added = true_signal(setup, {}) - true_signal(ends_at_lmax, {})
    expected = np.asarray(whole.coupling.dense())[:, N:] @ np.asarray(whole.sky.modes)[N:]
    # sums of 1e4 K
    np.testing.assert_allclose(added.ravel(), expected, atol=1e-10)
    np.testing.assert_array_equal(simulate(setup).truth[N:], whole.sky.modes[N:])


def test_beams_that_end_before_leave_a_map_and_a_doubt(monkeypatch):
    own = scenario(LMAX, "noise.above_lmax={}")
    data = replace(simulate(set_up(own)), truth=None)
    refused = Mock(side_effect=lb.InputError("72 azimuths cannot resolve lmax = 47"))
    monkeypatch.setattr("lusee_bayes.experiment.model.sky_above", refused)
    experiment = lb.build(own, data)
    assert experiment.setup.above is None and "72 azimuths" in experiment.doubts[0]
    monkeypatch.undo()
    monkeypatch.setattr("lusee_bayes.systematics.above_lmax.MOST_NUMBERS", 1e5)
    assert "too much memory" in lb.build(own, data).doubts[0]


@pytest.mark.parametrize("rows", [500, 700])
def test_main_directions_leave_out_as_little_as_singular_vectors(rows):
    white = np.random.default_rng(1).standard_normal((rows, 600)) * np.geomspace(30.0, 1e-4, 600)
    found = linalg.main_directions(white.T @ white, 1.0)
    np.testing.assert_allclose(found.T @ found, np.eye(found.shape[1]), atol=1e-9)
    left = np.vdot(white, white) - np.vdot(white @ found, white @ found)
    beyond = np.cumsum(np.linalg.svd(white)[1][::-1] ** 2)
    assert left < 1.0 and found.shape[1] <= (beyond > 1.0).sum() + 2


@pytest.mark.parametrize("top", [10, 24])
def test_the_directions_of_few_and_of_many_data_hold_what_these_see(top):
    """Their part of A' S' A'^T, in units of the noise, against all of it; of 256 data."""
    runs = "observation={runs: [{cycles: 0.3}], step_s: 50000}"
    setup = set_up(scenario(4, runs, f"noise.above_lmax={{margin: 1, least_lmax: {top}}}"))
    n, above, n_data = 25, setup.above, setup.layout.size
    assert (n_data < len(above.covariance)) == (top == 24)
    noise = np.sqrt(np.asarray(radiometer(setup).diagonal()))
    rows = np.asarray(above.coupling.dense())[:, n:] / noise[:, None]
    everything = rows @ above.covariance @ rows.T
    left = everything - rows @ above.root[n:] @ above.root[n:].T @ rows.T
    assert -1e-6 < np.trace(left) < above_lmax.LEFT_OUT
    white = np.linalg.solve(np.linalg.cholesky(above.covariance), above.root[n:])
    np.testing.assert_allclose(white.T @ white, np.eye(white.shape[1]), atol=1e-7)
    expected = (rows**2 @ np.diagonal(above.covariance)).sum()
    assert above.power.sum() == pytest.approx(expected, rel=1e-9)


PRIORS = ["isotropic", pytest.param("local_scales", marks=pytest.mark.essential)]


@pytest.mark.parametrize("prior", PRIORS)
def test_a_sky_that_does_not_end_at_lmax_has_error_bars_that_are_right(prior):
    """chi^2 per direction of those that the data know best; an order of magnitude off without."""
    given = "lmax=8", f"prior={{model: {prior}}}", "observation.step_s=14400"
    reach = "margin: 12, least_lmax: 0"
    sky = f"noise.above_lmax={{{reach}, treatment: ignored}}"
    data, found = simulate(set_up(lb.load_scenario("fiducial", [*given, sky]))), []
    for above in (f"{{{reach}}}", "null"):
        own = lb.load_scenario("fiducial", [*given, f"noise.above_lmax={above}"])
        posterior = lb.infer(lb.build(own, data)).posterior
        truth = np.asarray(data.truth)[: posterior.prior.size]
        white = posterior.prior.whiten(truth - posterior.mean)
        shares, directions = np.linalg.eigh(posterior.lower @ posterior.lower.T)
        known = shares > 1e2
        found.append(np.mean((directions.T @ white)[known] ** 2 * shares[known]))
    # an isotropic prior gives the sky between the spots of the plane more power than it has
    assert 0.2 < found[0] < 1.5 < 5.0 < found[1]
