"""Samples of positive skies as a user asks for them: the program log_normal."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpyro.infer.util import potential_energy

import lusee_bayes as lb
from lusee_bayes.core.harmonics import n_modes
from lusee_bayes.experiment.experiment import program_pieces
from lusee_bayes.results.sample_result import SampleResult
from lusee_bayes.runs.sample_run import coordinates
from lusee_bayes.sampling.programs import numpyro_promotion
from lusee_bayes.sky import positive_skies
from lusee_bayes.testing import small_scenario

LMAX = 4
NO_SOURCES = "log_normal={sources: false}"
# A and the tilt are drawn from a wider normal distribution: theirs is skewed
WIDER = np.array([1.3, 1.3, *np.ones(n_modes(LMAX))])


@pytest.fixture(scope="module", autouse=True)
def coarse_grid():
    """A grid that resolves products of these lmax, of a template that need not be exact."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(positive_skies, "LEAST_GRID", 24)
        yield


def weighted_draws(result: SampleResult, n: int) -> tuple[np.ndarray, np.ndarray]:
    """ln A, tilt and modes of n draws in straight coordinates, and their weights."""
    program, data = lb.load_program("log_normal"), result.experiment.data
    arguments = program.arguments(result.inference.model, program_pieces(result.experiment))
    prior = arguments["log_normal"]
    white = coordinates(program, arguments, data, result.inference, list(prior.sites))
    assert white.names == ("amplitude", "tilt", "structure")
    arguments = {**arguments, "data": data.data}

    @jax.jit
    def drawn(z):
        values, log_det = white.to_values(white.mean + white.root @ (WIDER * z))
        with numpyro_promotion():
            energy = potential_energy(program.model, (), arguments, values)
        log_amplitude, tilt = values["amplitude"], values["tilt"]
        sky = prior.sky.with_power_law(jnp.exp(log_amplitude), tilt).modes(values["structure"])
        row = jnp.concatenate([jnp.stack([log_amplitude, tilt]), sky])
        return row, log_det - energy + 0.5 * z @ z

    half = jax.random.normal(jax.random.key(3), (n // 2, len(WIDER)), dtype=jnp.float64)
    rows, log_weights = jax.jit(lambda z: jax.lax.map(drawn, z))(jnp.concatenate([half, -half]))
    weights = np.exp(np.asarray(log_weights) - float(log_weights.max()))
    # no draw counts for more than the root of their number (Ionides 2008)
    weights = np.minimum(weights, np.sqrt(n) * weights.mean())
    return np.asarray(rows), weights / weights.sum()


@pytest.mark.long
def test_samples_have_the_moments_of_weighted_draws(tmp_path):
    """Hamiltonian Monte Carlo and weighted draws, of the sky, A and the tilt."""
    scenario = small_scenario(NO_SOURCES, lmax=LMAX, cycles=0.1)
    sampler = lb.Sampler(chains=2, warmup=100, draws=500, seed=1)
    program = lb.load_program("log_normal")
    run = lb.run_sample(scenario, tmp_path / "samples", program=program, sampler=sampler)
    (sampled,) = run.result
    # tails of A where the sky hardly tells it are steep: one of a thousand may fail
    assert sampled.figures().divergences <= 5
    table = sampled.summary
    assert table["r_hat"].max() < 1.02
    rows, weights = weighted_draws(sampled, 4000)
    expected = weights @ rows
    std = np.sqrt(weights @ (rows - expected) ** 2)
    error = np.sqrt(1.0 / table["ess_bulk"].min() + (weights**2).sum())
    sites = sampled.tree["posterior"]
    others = [np.log(sites["amplitude"].values).ravel(), sites["tilt"].values.ravel()]
    found = np.column_stack([*others, sampled.skies.reshape(-1, n_modes(LMAX))])
    assert np.abs((found.mean(0) - expected) / std).max() < 4.5 * error
    # standard deviations of skewed distributions scatter by a few times 1 / sqrt(2 n)
    assert np.abs(found.std(0) / std - 1.0)[2:].max() < 4.5 * error


def test_the_scenario_says_what_is_sampled():
    sections = NO_SOURCES, "log_normal={amplitude: 0.02, tilt: -2.0}"
    built = (lb.build(small_scenario(section, lmax=LMAX, cycles=0.1)) for section in sections)
    learned, known = (program_pieces(experiment)["log_normal"]() for experiment in built)
    assert learned.sites == ("amplitude", "tilt", "structure")
    assert known.sites == ("structure",) and learned.sky.size == n_modes(LMAX) < known.sky.size
    expected = np.sqrt(0.02**2 * (np.arange(2.0, LMAX + 2.0) / 10.0) ** -2.0)
    np.testing.assert_allclose(np.sqrt(known.sky.spectrum[1:]), expected, rtol=1e-12)
