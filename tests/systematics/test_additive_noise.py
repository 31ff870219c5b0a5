"""Noise terms with a covariance of their own: a new one is a class with one method."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpyro import handlers

import lusee_bayes as lb
from lusee_bayes.instrument.products import DataLayout
from lusee_bayes.systematics.systematic import MOST_COLLAPSED, AdditiveNoise

N_PRODUCTS, N_TIMES, N_MODES = 4, 20, 9


class Pickup(AdditiveNoise):
    """Known patterns with unknown amplitudes."""

    patterns: jax.Array

    def covariance(self) -> lb.Covariance:
        return lb.LowRankCovariance(self.patterns, "the pickup")


class Correlated(AdditiveNoise):
    """Noise that lasts a while, of every product by itself."""

    hours: jax.Array

    def covariance(self) -> lb.Covariance:
        lag = self.hours[:, None] - self.hours[None]
        kernel = jnp.exp(-jnp.abs(lag) / 3.0)
        return lb.DenseCovariance(jnp.kron(jnp.eye(self.layout.n_products), kernel), "the hum")


@pytest.fixture(scope="module")
def model():
    rng = np.random.default_rng(0)
    return lb.LinearGaussian(
        jnp.asarray(rng.normal(size=(N_PRODUCTS * N_TIMES, N_MODES))),
        lb.HarmonicPrior(jnp.ones(3)),
        lb.DiagonalCovariance(jnp.full(N_PRODUCTS * N_TIMES, 0.1)),
    )


def terms():
    layout = DataLayout(N_PRODUCTS, N_TIMES)
    patterns = np.random.default_rng(1).normal(size=(layout.size, 2))
    return [
        Pickup("pickup", layout, jnp.asarray(patterns)),
        Correlated("hum", layout, jnp.arange(float(N_TIMES))),
    ]


@pytest.mark.parametrize("term", terms(), ids=lambda term: term.name)
def test_marginalised_and_sampled_are_one_distribution(model, term):
    """The offset is linear in the site's normals, with the covariance that N is given."""
    dense = np.asarray(term.covariance().dense())
    added = np.asarray(term.marginalised(model).noise.dense() - model.noise.dense())
    np.testing.assert_allclose(added, dense, rtol=0, atol=1e-13)
    rank = term.covariance().rank

    def offset(z):
        with handlers.seed(rng_seed=0), handlers.substitute(data={f"{term.name}_noise": z}):
            return term.sampled(model).offset

    with handlers.seed(rng_seed=0), handlers.trace() as trace:
        term.sampled(model)
    fn = trace[f"{term.name}_noise"]["fn"]
    z = jnp.arange(float(rank))
    expected = -0.5 * (z**2).sum() - 0.5 * rank * np.log(2.0 * np.pi)
    assert float(fn.log_prob(z)) == pytest.approx(float(expected), rel=1e-13)
    root = np.asarray(jax.jit(jax.jacfwd(offset))(jnp.zeros(rank)))
    np.testing.assert_allclose(root @ root.T, dense, rtol=0, atol=1e-12)
    np.testing.assert_array_equal(offset(jnp.zeros(rank)), 0.0)
    assert term.needs_sky == (rank > MOST_COLLAPSED)
    assert not term.changes_coupling


def test_sampled_noise_is_added_to_what_is_there(model):
    background = jnp.arange(float(model.n_data))
    given = lb.LinearGaussian(model.coupling, model.prior, model.noise, background)
    term = terms()[0]
    with handlers.seed(rng_seed=0), handlers.trace() as trace:
        sampled = term.sampled(given)
    expected = background + term.patterns @ trace["pickup_noise"]["value"]
    np.testing.assert_allclose(sampled.offset, expected, rtol=1e-14)


@pytest.mark.parametrize("term", terms(), ids=lambda term: term.name)
def test_simulated_data_hold_a_draw_of_it(term):
    grid = jnp.ones((N_PRODUCTS, N_TIMES))
    key = jax.random.key(3)
    drawn = np.asarray(term.layout.gather(term.distort(grid, key) - grid))
    np.testing.assert_allclose(drawn, term.covariance().sample(key), rtol=0, atol=1e-14)
    # the covariance of 400 draws: each of 3240 entries within 5.5 of its standard errors
    draws = np.asarray(term.covariance().sample(key, 400))
    dense = np.asarray(term.covariance().dense())
    error = np.sqrt((np.outer(np.diag(dense), np.diag(dense)) + dense**2) / 400)
    assert np.abs((draws.T @ draws / 400 - dense) / error).max() < 5.5


def test_samples_that_are_not_there_stay_as_they_are():
    flags = np.zeros((N_PRODUCTS, N_TIMES), dtype=bool)
    flags[1, 3:5] = True
    layout = DataLayout.from_flags(flags)
    term = Pickup("pickup", layout, jnp.ones((layout.size, 1)))
    changed = np.asarray(term.distort(jnp.zeros(flags.shape), jax.random.key(0)))
    np.testing.assert_array_equal(changed == 0.0, flags)
