"""A channel's map: likelihoods of its draws, and which groups of its data are judged."""

from dataclasses import replace

import arviz_base as az
import arviz_stats
import jax.numpy as jnp
import numpy as np
import pytest
from commands import posterior_of, sky_draws_of
from experiments import channels_of, correlated, mapped, scaled_product, small_experiment
from reference_linear import matrices
from scipy import stats

import lusee_bayes as lb
from lusee_bayes.core import arrays, harmonics
from lusee_bayes.experiment import rounds
from lusee_bayes.experiment.model import set_up, simulate
from lusee_bayes.judge.chi2 import stands_out
from lusee_bayes.judge.split import Split
from lusee_bayes.linear.posterior import pixel_std
from lusee_bayes.results.channel_map import conditioned, region_rows
from lusee_bayes.results.finished_runs import FinishedRun, SavedInformation
from lusee_bayes.results.summaries import MapSummary
from lusee_bayes.testing import small_scenario


def dense_log_likelihood(model, data, skies) -> np.ndarray:
    """ln N(d; A m + offset, N) with matrices."""
    predicted = [np.asarray(model.predict(jnp.asarray(sky))) for sky in skies]
    noise = stats.multivariate_normal(np.zeros(len(data)), np.asarray(model.noise.dense()))
    return noise.logpdf(np.asarray(data) - predicted)


def dense_z(judged, data) -> np.ndarray:
    """Every datum against all others, of independent noise: K^-1 = N^-1 - (Q of a QR) (its Q)^T."""
    model, n = arrays.on_host(judged.model), len(data)
    prior = Split.of(judged.posterior, judged.solution.chi2, n).wide.prior
    a, std = np.asarray(model.coupling.dense()), np.sqrt(np.asarray(model.noise.diagonal()))
    white = prior.colour_columns(a) / std[:, None]
    q = np.linalg.qr(np.concatenate([white, np.eye(white.shape[1])]))[0][:n]
    off = (np.asarray(data) - np.asarray(model.predict(prior.colour(prior.white_mean)))) / std
    return (off - q @ (q.T @ off)) / np.sqrt(1.0 - (q**2).sum(1))


# banded, and templates; diagonal below
NOISES = ["noise.gain={sigma: 0.01}"], ["noise.radiometer.form=exact", "noise.beam={shift_mhz: 1}"]


@pytest.mark.parametrize("noise", NOISES)
def test_likelihoods_of_draws_are_those_of_matrices(noise):
    made, channel = mapped(small_experiment("output.draws=4", *noise))
    expected = dense_log_likelihood(made.from_data.model, made.experiment.data.data, channel.draws)
    # the rounding of N^-1, times chi^2
    rounding = np.linalg.cond(np.asarray(made.from_data.model.noise.dense())) * 1e-15 * 100
    np.testing.assert_allclose(channel.log_likelihood, expected, atol=rounding)
    assert len(expected) == 4 and np.ptp(expected) > 0.1


def test_arviz_opens_a_posterior(small_cube):
    """With the groups and dimensions of ArviZ, and the likelihood of every channel's draws."""
    tree = posterior_of(small_cube.folder)
    assert {"posterior", "log_likelihood", "observed_data", "constant_data"} == set(tree.children)
    sky, result = tree["posterior"]["sky"], small_cube.result
    assert sky.dims == ("chain", "draw", "frequency", "mode") and sky.shape == (1, 3, 3, 25)
    np.testing.assert_array_equal(sky["frequency"], [20.0, 25.0, 30.0])
    assert az.extract(tree, num_samples=3).sizes["sample"] == 3
    assert len(arviz_stats.summary(tree, kind="stats")) == 75
    assert tree["log_likelihood"]["visibility"].dims == ("chain", "draw", "frequency")
    for k, channel in enumerate(result.channels):
        np.testing.assert_array_equal(sky_draws_of(small_cube.folder)[k], channel.draws)
        experiment = lb.build(result.scenario.channels()[k])
        model, data = lb.infer(experiment).model, experiment.data
        told = tree["log_likelihood"]["visibility"].isel(chain=0, frequency=k)
        expected = dense_log_likelihood(model, data.data, channel.draws)
        np.testing.assert_allclose(told, expected, atol=1e-6)
        seen = tree["observed_data"]["visibility"].isel(frequency=k)
        np.testing.assert_array_equal(seen, data.grid())
        assert list(tree["observed_data"]["product"].values) == list(data.labels)
        angles = tree["constant_data"]["turntable_deg"].isel(frequency=k)
        turntable = np.asarray(data.observation.turntable_deg)
        np.testing.assert_array_equal(angles, turntable[data.observation.run])


def test_data_of_channels_at_other_times_have_gaps(tmp_path, numbers_alone):
    scenario = small_scenario("frequencies_mhz=[20, 25]", lmax=3, cycles=0.1)
    first, second = channels_of(scenario)
    both = [first, second.select(np.arange(second.observation.n_times) >= 5)]
    run = lb.run_map(scenario, tmp_path / "run", data=both)
    seen = posterior_of(run.folder)["observed_data"]["visibility"]
    # the second begins ten hours later; hours to 1e-6
    hours = [one.observation.hours + begin for one, begin in zip(both, (0.0, 10.0), strict=True)]
    for k, data in enumerate(both):
        there = seen.isel(frequency=k).dropna("time")
        np.testing.assert_allclose(there["time"], hours[k], rtol=0, atol=1e-6)
        np.testing.assert_array_equal(there, data.grid())
    assert seen.sizes["time"] == len(hours[0])


@pytest.fixture(scope="module")
def bad(tmp_path_factory):
    """Data of three channels; a product of the second is too large."""
    scenario = small_scenario("frequencies_mhz=[20, 25, 30]", lmax=4, cycles=0.1)
    data = channels_of(scenario)
    data[1] = scaled_product(data[1], 8, 1.2)
    return scenario, data


def run_of(bad, folder, **options):
    scenario, data = bad
    return lb.run_map(scenario, folder, data=data, **options)


@pytest.fixture(scope="module")
def judged_run(bad, tmp_path_factory):
    return run_of(bad, tmp_path_factory.mktemp("bad") / "run")


def test_groups_of_a_channel_are_judged_where_it_does_not_fit(judged_run):
    first, second, third = judged_run.result.channels
    assert first.judged is None and third.judged is None
    assert first.diagnosis is None and third.diagnosis is None
    judged = second.judged
    assert judged.level == "does not fit" and "product 12R" in judged.suspects
    assert stands_out(second.instrument.p, 12)
    assert len(judged.of_kind("product")) == 16 and judged.of_kind("day")
    # what is tried where a map of one frequency does not fit
    assert second.diagnosis is not None and second.pointing is not None


def test_they_are_named_wherever_the_verdict_is(judged_run):
    result, path = judged_run.result, judged_run.folder / "summary.json"
    summary = MapSummary.model_validate_json(path.read_bytes())
    assert result.fit.level == summary.level == "does not fit"
    assert f"25 MHz: {result.channels[1].judged.fit.details}" in result.verdict()
    assert summary.verdict == result.verdict()
    assert summary.channels[1].judged.suspects == list(result.channels[1].judged.suspects)
    assert summary.channels[0].judged is None
    assert any(line.startswith("25 MHz: ") for line in result.lines()[1:])
    page = (judged_run.folder / "report.html").read_text()
    assert "Did you mean?" in page and "<tr class=bad><td>12R</td>" in page
    assert "groups were not tested" in page
    assert (judged_run.folder / "figures" / "groups.png").is_file()


def test_as_in_a_map_of_its_own(bad, judged_run):
    scenario, data = bad
    _, expected = mapped(lb.build(scenario.channels()[1], data[1]))
    here, there = judged_run.result.channels[1].judged, expected.judged
    assert here.suspects == there.suspects and here.level == there.level
    np.testing.assert_allclose(here.z, there.z, rtol=0, atol=1e-6)
    for one, other in zip(here.groups, there.groups, strict=True):
        assert one.name == other.name and one.chi2 == pytest.approx(other.chi2, rel=1e-6)


def test_every_channel_is_judged_if_that_is_asked_for(bad, tmp_path, numbers_alone):
    result = run_of(bad, tmp_path / "run", thorough=True).result
    assert [c.judged is None for c in result.channels] == [False] * 3
    assert [c.judged.level for c in result.channels] == ["consistent", "does not fit", "consistent"]
    assert all(c.diagnosis is not None for c in result.channels)
    np.testing.assert_array_equal(posterior_of(tmp_path / "run")["mean"], result.stacked("mean"))


def test_a_sky_above_lmax_that_no_one_expected_blames_no_data(monkeypatch):
    given = "noise.above_lmax={margin: 8, least_lmax: 0}", "observation.step_s=14400"
    scenario = lb.load_scenario("fiducial", ["lmax=6", *given])
    setup = set_up(scenario)
    brighter = replace(setup.above, modes=10.0 * setup.above.modes)
    data = replace(simulate(replace(setup, above=brighter)), truth=None)
    found = mapped(experiment := lb.build(scenario, data))[1]
    assert found.judged.level != "does not fit" and "above lmax is not as" in found.doubts[0]
    monkeypatch.setattr(rounds, "model_of_whole_sky", lambda *_: None)
    assert mapped(experiment)[1].judged.level == "does not fit"


def test_modes_that_the_prior_knows_exactly_can_have_earlier_data():
    """A C_ell of zero: the prior that earlier data leave has a density anyway."""
    experiment = small_experiment()
    spectrum = np.array(experiment.setup.prior.spectrum)
    spectrum[3] = 0.0
    setup = replace(experiment.setup, prior=lb.HarmonicPrior(jnp.asarray(spectrum)))
    experiment = replace(experiment, setup=setup)
    data = experiment.data
    other = replace(experiment, data=replace(data, data=data.data + 1e-9 * jnp.abs(data.data)))
    first = conditioned(other)
    made, channel = mapped(experiment, SavedInformation(first.information, first.digests))
    assert (channel.std[9:16] == 0).all() and (channel.mean[9:16] == 0).all()
    expected = first.information + conditioned(experiment).information
    np.testing.assert_allclose(channel.std, expected.posterior(setup.prior).std(), rtol=1e-4)
    # the same data twice: what the second asks of the first is nothing
    assert channel.chi2_model < 1.5 * channel.n_data
    expected = dense_z(made.judged, data.data)
    # a mean is accepted where each of its 49 coefficients is known to 1e-6 standard deviations
    std = np.sqrt(np.asarray(made.from_data.model.noise.diagonal()))
    reach = np.abs(setup.coupling.dense()) @ channel.std / std
    np.testing.assert_allclose(channel.judged.z.ravel(), expected, rtol=0, atol=1e-6 * reach.max())


JOINT = ["joint=true", "spectral.components=[power_law]"]


@pytest.mark.parametrize("kind", [[], JOINT], ids=["independent", "joint"])
def test_covariances_of_every_channel_are_kept(kind, tmp_path, numbers_alone):
    """And with all that can be asked for at once, every channel is judged."""
    given = "output={covariance: true, draws: 2, information: true}", *kind
    scenario = small_scenario("frequencies_mhz=[20, 25, 30]", *given, lmax=3, cycles=0.1)
    run = lb.run_map(scenario, tmp_path / "run", thorough=True)
    tree = posterior_of(run.folder)
    assert tree["covariance"].dims == ("frequency", "mode", "mode_2")
    variances = np.diagonal(tree["covariance"].values, axis1=1, axis2=2)
    np.testing.assert_allclose(np.sqrt(variances), tree["std"], rtol=1e-9)
    assert list(tree["information"].children) == ["20", "25", "30"]
    for channel in run.result.channels:
        assert channel.judged.level == "consistent" and channel.diagnosis is not None
    # what is written is read back
    for here, there in zip(run.result.channels, FinishedRun.read(run.folder).channels, strict=True):
        assert here.judged.suspects == there.judged.suspects
        assert repr(here.judged.groups) == repr(there.judged.groups)  # with NaN
        assert here.diagnosis == there.diagnosis and here.coverage == there.coverage
        np.testing.assert_array_equal(here.mean, there.mean)
        np.testing.assert_array_equal(here.judged.z, there.judged.z)


# --- under a prior that correlates modes ----------------------------------------------------------


LMAX = 6


@pytest.fixture(scope="module")
def dense():
    """The experiment conditioned on its data, and the channel."""
    experiment = lb.build(small_scenario(lmax=LMAX, cycles=0.1))
    setup = replace(experiment.setup, prior=correlated(experiment.setup.prior))
    return mapped(replace(experiment, setup=setup))


def test_the_channel_is_that_of_matrices(dense):
    made, channel = dense
    model, data = made.from_data.model, np.asarray(made.experiment.data.data)
    (a, s, n), mean = matrices(model), np.asarray(model.prior.mean)
    covariance = np.asarray(made.from_all.posterior.covariance())
    # chi^2 of residuals: N_data less what the sky takes, tr(A C A^T N^-1)
    taken = np.trace(np.linalg.solve(n, a @ covariance @ a.T))
    np.testing.assert_allclose(channel.chi2_expected, len(data) - taken, rtol=1e-6)
    np.testing.assert_allclose(channel.prior_std, np.sqrt(np.diag(s)), rtol=1e-12)
    centred = data - a @ mean
    centred = centred if model.offset is None else centred - np.asarray(model.offset)
    k = a @ s @ a.T + n
    # K spans ten orders of magnitude
    np.testing.assert_allclose(channel.chi2_model, centred @ np.linalg.solve(k, centred), rtol=1e-4)
    parts = channel.instrument.chi2 + channel.judged.prior.chi2
    np.testing.assert_allclose(parts, channel.chi2_model, rtol=1e-6)
    # shares of the prior, the monopole taken for known
    rest, left = s.copy(), covariance.copy()
    for matrix in (rest, left):
        matrix[0] = matrix[:, 0] = 0.0
    share = (pixel_std(left, channel.nside) / pixel_std(rest, channel.nside)) ** 2
    np.testing.assert_allclose(channel.details.prior_fraction, share, rtol=1e-8)
    rows = region_rows(channel.nside, LMAX)
    share = ((rows @ left) * rows).sum(1) / ((rows @ rest) * rows).sum(1)
    np.testing.assert_allclose(channel.details.region_prior_fraction, share, rtol=1e-8)


def test_its_resolution_is_packed(dense):
    made, channel = dense
    details = channel.details
    width = details.prior_width
    ell, _ = harmonics.mode_numbers(LMAX)
    steps, scale = details.resolution_step[np.ix_(ell, ell)], width[:, None] / width[None]
    found = details.resolution * steps * scale
    s = np.asarray(made.from_data.model.prior.covariance())
    exact = np.eye(len(s)) - np.asarray(made.from_all.posterior.covariance()) @ np.linalg.inv(s)
    assert (np.abs(found - exact) <= 0.51 * steps * scale).all()
