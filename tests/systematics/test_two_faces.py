"""Gains marginalised to first order in N, and gains sampled exactly: where they agree, and not."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from arviz_stats.base import array_stats
from experiments import small_experiment
from numpyro.infer.util import log_density
from reference_linear import z_of
from scipy.stats import norm

import lusee_bayes as lb
from lusee_bayes.experiment.model import full_model, radiometer
from lusee_bayes.experiment.pieces import program_pieces
from lusee_bayes.experiment.terms import Around, gain_drifts
from lusee_bayes.sampling.promotion import numpyro_promotion

GAINS = "noise.gain={sigma: %g, correlation_h: 10, treatment: %s, visibilities: %s}"
# of the product (1 + g)(1 + g'), with the gains and the sky by hand
PAIRS = [(0, 0), (0, 1), (0, 1), (0, 2), (0, 2), (0, 3), (0, 3), (1, 1), (1, 2), (1, 2), (1, 3),
         (1, 3), (2, 2), (2, 3), (2, 3), (3, 3)]  # fmt: skip


def experiment(sigma=1e-3, treatment="sampled", around="model") -> lb.Experiment:
    return small_experiment(GAINS % (sigma, treatment, around))


def test_the_program_is_the_exact_product_of_gains():
    """Density of sky and white noise against scipy's, with gains worked out antenna by antenna."""
    e = experiment(0.05)
    setup, data = e.setup, e.data
    program = lb.load_program("gains")
    arguments = {**program.arguments(full_model(setup), program_pieces(e)), "data": data.data}
    drifts = arguments["gain_drifts"]
    rng = np.random.default_rng(0)
    white = rng.normal(size=(4, drifts.grid.shape[0]))
    sky = np.asarray(setup.prior.sample(jax.random.key(1)))
    hours, grid = data.observation.hours, np.asarray(drifts.grid)
    shape = np.sqrt((grid[1] - grid[0]) / 10.0 * np.sqrt(2 / np.pi))
    gains = 0.05 * shape * white @ np.exp(-(((hours[None] - grid[:, None]) / 10.0) ** 2))
    seen = np.asarray(setup.coupling.dense()) @ sky
    for k, (i, j) in enumerate(PAIRS):
        at = slice(k * len(hours), (k + 1) * len(hours))
        seen[at] *= (1 + gains[i]) * (1 + gains[j])
    expected = norm.logpdf(white).sum()
    expected += norm.logpdf(sky, 0, np.sqrt(np.asarray(setup.prior.variance()))).sum()
    sigma = np.sqrt(np.asarray(radiometer(setup).diagonal()))
    expected += norm.logpdf(np.asarray(data.data), seen, sigma).sum()
    with numpyro_promotion():
        got, trace = log_density(
            program.model,
            (),
            arguments,
            {"sky": jnp.asarray(sky), "gain_noise": jnp.asarray(white)},
        )
    # residuals of many sigma: squares of 1e5 sigma, each to 1e-10 of itself
    assert float(got) == pytest.approx(expected, rel=1e-9)
    np.testing.assert_allclose(trace["gains"]["value"], gains, rtol=0, atol=1e-15)


def test_white_noise_makes_drifts_of_the_right_covariance():
    """The response of histories to white noise, squared, is C_g: to exp(-9 pi^2 / 2) = 5e-20."""
    drifts = gain_drifts(experiment().setup, Around())
    hours = np.asarray(drifts.hours)
    for correlation_h in (10.0, 14.0, 20.0):
        drift = lb.GainDrift(0.02, correlation_h)
        # a margin for 10 hours cuts off longer ones at exp(-(60 / t)^2 2)
        unit = jnp.eye(drifts.grid.shape[0])
        root = np.asarray(drift.history(unit, hours, drifts.grid))
        lag = hours[:, None] - hours[None]
        expected = 4e-4 * np.exp(-(lag**2) / (2 * correlation_h**2))
        cut = np.exp(-2 * (60.0 / correlation_h) ** 2)
        np.testing.assert_allclose(root.T @ root, expected, rtol=0, atol=4e-4 * (1e-14 + cut))


def sampled(e, seed=3):
    program, inference = lb.load_program("gains"), lb.infer(e)
    posterior = inference.posterior
    pieces = program.arguments(inference.model, program_pieces(e))
    arguments = {**pieces, "data": e.data.data}
    approximation = lb.laplace_approximation(program.model, arguments, {"sky": posterior.mean})
    assert bool(approximation.converged)
    sampler = lb.Sampler(draws=1500, seed=seed)
    return lb.sample(program.model, arguments, sampler, approximation.whitening), posterior


@pytest.mark.long
def test_small_gains_marginalised_and_sampled_give_the_same_sky():
    """sigma_g = 1e-3: mean and variance of every mode to Monte Carlo error.

    What first order leaves out is of order sigma_g of an uncertainty: 1e-3 of a standard deviation,
    a tenth of the Monte Carlo error of 6000 draws.
    """
    e = experiment(1e-3, "sampled", "posterior")
    setup, data = e.setup, e.data
    chains, posterior = sampled(e)
    assert not chains.statistics["diverging"].any()
    std = np.asarray(posterior.std())
    z = (chains.sites["sky"] - np.asarray(posterior.mean)) / std
    limit = z_of(2 * z.shape[-1])
    for mode in range(z.shape[-1]):
        for values, expected in [(z[..., mode], 0.0), (z[..., mode] ** 2, 1.0)]:
            ess = array_stats.ess(values, chain_axis=0, draw_axis=1, method="mean")
            off = (values.mean() - expected) / (values.std() / np.sqrt(ess))
            assert abs(off) < limit, (mode, expected, off)
    # and not the sky without gains: the test can tell
    bare = lb.LinearGaussian(setup.coupling, setup.prior, radiometer(setup)).condition(data.data)
    assert np.abs((np.asarray(bare.mean) - np.asarray(posterior.mean)) / std).max() > 1.0
    assert (np.asarray(bare.std()) / std).min() < 0.8
