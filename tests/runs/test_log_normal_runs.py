"""Maps and samples of positive skies as a user asks for them: prior.model=lognormal."""

from __future__ import annotations

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import xarray as xr

import lusee_bayes as lb
from lusee_bayes.cli.main import main
from lusee_bayes.core.arrays import on_device
from lusee_bayes.core.errors import InputError
from lusee_bayes.core.harmonics import modes_to_map, n_modes
from lusee_bayes.experiment.inference import infer
from lusee_bayes.experiment.model import full_model
from lusee_bayes.experiment.pieces import program_pieces
from lusee_bayes.results.map_result import map_result
from lusee_bayes.results.prior_words import prior_sentence
from lusee_bayes.runs.sample_run import default_program
from lusee_bayes.sampling.hmc import Sampler
from lusee_bayes.sky import log_normal, write_alms
from lusee_bayes.testing import small_scenario

LMAX = 6
PRIOR = "prior={model: lognormal, sources: false}"
KNOWN = "prior={model: lognormal, amplitude: 0.02, tilt: -2.5}"
SIZES = {"lmax": LMAX, "cycles": 0.1}


@pytest.fixture(scope="module", autouse=True)
def coarse_grid():
    """A grid that resolves products of these lmax, of a template that need not be exact."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(log_normal, "LEAST_GRID", 24)
        yield


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    scenario = small_scenario(PRIOR, "output={draws: 10, covariance: true}", **SIZES)
    return lb.run_map(scenario, tmp_path_factory.mktemp("lognormal") / "map")


def test_mean_covariance_and_evidence_are_those_of_laplace(run):
    """All from A, N, d and derivatives by JAX, without what finds the mode."""
    result, learned = run.result, run.result.experiment.learned
    sky = on_device(learned.posterior.mode.sky)
    white = jnp.asarray(learned.posterior.mode.white)
    model = full_model(result.experiment.setup)
    dense = np.asarray(model.coupling.dense())
    noise = np.asarray(model.noise.diagonal())
    data = np.asarray(result.experiment.data.data)

    def energy(u):
        off = data - dense @ sky.modes(u)
        return 0.5 * ((off**2 / noise).sum() + u @ u)

    jacobian = np.asarray(jax.jit(jax.jacfwd(sky.modes))(white))
    seen = dense @ jacobian
    curvature = seen.T @ (seen / noise[:, None]) + np.eye(sky.size)
    # in standard deviations; the search stops at 1e-3
    slope = np.asarray(jax.jit(jax.grad(energy))(white))
    assert np.sqrt(slope @ np.linalg.solve(curvature, slope)) < 2e-3
    covariance = jacobian @ np.linalg.solve(curvature, jacobian.T)
    std = np.sqrt(np.diag(covariance))
    with xr.open_dataset(run.folder / "posterior.nc", engine="h5netcdf") as file:
        assert np.abs((file["mean"].values - np.asarray(sky.modes(white))) / std).max() < 2e-3
        off = (file["covariance"].values - covariance) / np.outer(std, std)
    assert np.abs(off).max() < 1e-6
    expected = -float(energy(white)) - 0.5 * (
        np.linalg.slogdet(curvature)[1] + np.log(2.0 * np.pi * noise).sum()
    )
    found = json.loads((run.folder / "summary.json").read_text())
    assert found["log_evidence"] == pytest.approx(expected, abs=1e-3)
    assert [row["name"] for row in found["prior_parameters"]] == ["ln A", "tilt"]


def test_no_pixel_of_any_draw_is_negative(run):
    with xr.open_dataset(run.folder / "posterior.nc", engine="h5netcdf") as file:
        pixels, draws = file["draw_pixels"].values, file["draws"].values
    assert pixels.shape == (10, 12 * 8**2) and draws.shape == (10, n_modes(LMAX))
    assert pixels.min() > 0
    # the mean temperature: sums over pixels of a sky that varies by half within one
    np.testing.assert_allclose(pixels.mean(1), draws[:, 0] / np.sqrt(4.0 * np.pi), rtol=0.02)
    shown = run.result.diagnostics["draws"].values
    assert shown.min() > 0


def test_standard_deviations_are_those_of_the_draws(run):
    experiment, channel = run.result.experiment, run.result.channel
    drawn = experiment.positive.drawn(jax.random.key(5), 400)
    # a standard deviation of 400 draws is good to 3.5 %, with the weights of the draws to 5 %
    assert np.sqrt(np.mean((drawn.skies.std(0) / channel.std - 1.0) ** 2)) < 0.1
    maps = np.stack([modes_to_map(sky, channel.nside) for sky in drawn.skies])
    assert np.sqrt(np.mean((maps.std(0) / channel.pixel_std - 1.0) ** 2)) < 0.1


def test_a_spectrum_that_is_given_is_not_learned():
    experiment = lb.build(small_scenario(KNOWN, **SIZES))
    assert experiment.learned.as_rows() == []
    assert prior_sentence(experiment) == "Prior lognormal, C_ell given in the scenario."
    found = float(infer(experiment).posterior.log_evidence)
    assert found == pytest.approx(experiment.learned.log_evidence, abs=1e-4)


@pytest.mark.long
def test_it_is_one_of_the_priors_that_are_compared(tmp_path):
    scenario = small_scenario(PRIOR, **SIZES)
    result = lb.run_compare_priors(scenario, tmp_path / "x", ["isotropic", "lognormal"]).result
    found = {one.name: one for one in result.priors}["lognormal"]
    assert found.n_parameters == 2
    assert found.log_evidence == pytest.approx(lb.build(scenario).learned.log_evidence, abs=1e-3)
    # Laplace's formula misses little where draws in straight coordinates have even weights
    assert found.sampled.is_trusted
    assert abs(found.sampled.value - found.log_evidence) < 1.0


def dark_template(folder):
    """The sky of a file that is negative in places."""
    modes = np.zeros(n_modes(LMAX))
    modes[0], modes[2] = 1e5, 2e5
    return write_alms(folder / "dark.fits", modes, {})


@pytest.mark.parametrize(
    ("prior", "message"),
    [
        ("template: dark.fits", "the template must be positive"),
        ("amplitude: 0, tilt: -2", "prior.amplitude"),
        ("amplitude: -0.1, tilt: -2", "prior.amplitude"),
        ("amplitude: 0.1", "give both amplitude and tilt, or neither"),
        ("tilt: -2", "give both amplitude and tilt, or neither"),
        ("scale_std: 0", "prior.scale_std"),
        ("template: no.fits", "no.fits"),
    ],
    ids=str,
)
def test_bad_input_is_one_sentence(prior, message, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    dark_template(tmp_path)
    arguments = ["--set", f"lmax={LMAX}", "--set", "observation.runs.0.cycles=0.1"]
    command = ["map", "fiducial", *arguments, "--set", f"prior={{model: lognormal, {prior}}}"]
    assert main([*command, "-o", str(tmp_path / "x")]) == 2
    said = capsys.readouterr().err
    assert message in " ".join(said.split()) and said.count("\n") <= 2
    assert not (tmp_path / "x").exists()


def test_what_it_cannot_do_is_said(run):
    scenario = small_scenario(PRIOR, "noise.gain={treatment: sampled}", **SIZES)
    with pytest.raises(InputError, match="the sky and its prior are sampled, and nothing else"):
        default_program(scenario)
    repeated = small_scenario(PRIOR, "noise.gain={visibilities: posterior}", **SIZES)
    with pytest.raises(InputError, match="found under one N"):
        lb.build(repeated)
    isotropic = lb.build(small_scenario(**SIZES))
    with pytest.raises(InputError, match=r"set prior\.model=lognormal"):
        program_pieces(isotropic)["log_normal"]()
    with pytest.raises(InputError, match="a log-normal map cannot be updated"):
        map_result(run.result.experiment, onto=run.folder)


@pytest.mark.long
def test_channels_of_a_cube_are_maps(tmp_path):
    cube = lb.run_map(
        small_scenario(PRIOR, "frequencies_mhz=[20.0, 30.0]", **SIZES), tmp_path / "c"
    )
    alone = lb.run_map(small_scenario(PRIOR, "frequency_mhz=20.0", **SIZES), tmp_path / "m")
    one, other = cube.result.channels[0], alone.result.channel
    np.testing.assert_allclose(one.mean, other.mean, rtol=0, atol=1e-6 * np.abs(other.mean).max())
    # rounding of the curvature, which other threads do in another order, times its condition number
    lower = alone.result.experiment.learned.posterior.mode.lower
    rounding = np.finfo(float).eps * np.linalg.cond(lower) ** 2
    assert rounding < 1e-4
    np.testing.assert_allclose(one.pixel_std, other.pixel_std, rtol=rounding)


@pytest.mark.long
def test_samples_have_the_moments_of_weighted_draws(tmp_path):
    """Hamiltonian Monte Carlo and importance sampling, of the sky, A and the tilt."""
    scenario = small_scenario(PRIOR, lmax=4, cycles=0.1)
    sampler = Sampler(chains=2, warmup=100, draws=500, seed=1)
    (sampled,) = lb.run_sample(scenario, tmp_path / "samples", sampler=sampler).result
    figures = sampled.figures()
    # tails of A where the sky hardly tells it are steep: one of a thousand may fail
    assert figures["program"] == "log_normal" and figures["divergences"] <= 5
    table = sampled.summary_table()
    assert table["r_hat"].max() < 1.02
    posterior = sampled.experiment.positive.posterior
    draws = posterior.sample(jax.random.key(3), 4000)
    expected, std = draws.mean(draws.skies), np.sqrt(draws.variance(draws.skies))
    error = np.sqrt(1.0 / table["ess_bulk"].min() + 1.0 / draws.effective)
    skies = sampled.skies.reshape(-1, n_modes(4))
    assert np.abs((skies.mean(0) - expected) / std).max() < 4.5 * error
    # standard deviations of skewed distributions scatter by a few times 1 / sqrt(2 n)
    assert np.abs(skies.std(0) / std - 1.0).max() < 4.5 * error
    for number, name in enumerate(("amplitude", "tilt")):
        values = sampled.tree["posterior"][name].values
        values = np.log(values) if name == "amplitude" else values
        own = draws.parameters[:, number : number + 1]
        expected, std = draws.mean(own)[0], np.sqrt(draws.variance(own))[0]
        assert abs(values.mean() - expected) / std < 4.5 * error
