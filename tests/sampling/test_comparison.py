"""Evidences and predictions of programs against brute force: quadrature, and dense Gaussians."""

from __future__ import annotations

from functools import lru_cache

import arviz_base
import jax.numpy as jnp
import numpy as np
import numpyro
import pytest
from assertions import refuse
from numpyro import distributions as dist
from scipy.stats import multivariate_normal, norm
from small_models import Case

import lusee_bayes as lb
from lusee_bayes.noise.covariance import DenseCovariance
from lusee_bayes.sampling import evidence as comparison
from lusee_bayes.sampling.mode import laplace_approximation
from lusee_bayes.sampling.programs import Program


def log_normal(d, covariance, mean=0.0) -> float:
    """By scipy."""
    return float(multivariate_normal.logpdf(d, np.zeros(len(d)) + mean, covariance))


def log_integral(log_p, *nodes) -> float:
    """Of exp(log_p) over a regular grid, which is exact for smooth densities well inside."""
    weights = np.exp(log_p - log_p.max())
    for axis in range(weights.ndim):
        edges = weights.take([0, -1], axis=axis)
        assert edges.sum() < 1e-5 * weights.sum()
    cell = np.prod([x[1] - x[0] for x in nodes])
    return float(log_p.max() + np.log(weights.sum() * cell))


LEVELS = np.linspace(-5.0, 5.0, 401)
AMPLITUDES, TILTS = np.linspace(-3.0, 3.0, 61), np.linspace(-3.0, 3.0, 61)


SPECTRUM = [4.0, 2.0, 1.0]


@lru_cache
def case(level: float = 4.0) -> Case:
    """Of a sky with 9 modes, and noise whose true level is not one."""
    return Case.drawn(SPECTRUM, 30, 3, 2.0, level)


def fixed_noise(coupling, offset, prior, noise, data=None):
    """A program that knows the noise level, and not the sky's."""
    amplitude = numpyro.sample("amplitude", dist.LogNormal(0.0, 0.5))
    prior = lb.HarmonicPrior(prior.spectrum * amplitude)
    gaussian = lb.LinearGaussian(coupling, prior, noise, offset)
    numpyro.sample("data", lb.Marginal(gaussian), obs=data)
    return gaussian


def log_spectrum(x: float, tilt: float) -> float:
    """ln p(d, x, tilt) of prior_amplitude, x = ln A ~ N(0, 0.5^2) as the tilt."""
    priors = norm.logpdf(x, 0, 0.5) + norm.logpdf(tilt, 0, 0.5)
    return case().given(np.exp(x), tilt).log_prob + priors


@lru_cache
def level_grid() -> np.ndarray:
    """ln p(d, x) of sky_marginal, x = ln level ~ N(0, 1)."""
    return np.array([case().given(level=np.exp(x)).log_prob + norm.logpdf(x) for x in LEVELS])


@lru_cache
def spectrum_grid() -> np.ndarray:
    return np.array([[log_spectrum(x, t) for t in TILTS] for x in AMPLITUDES])


@lru_cache
def program(name: str):
    """Loaded once: each load is a function of its own, to be compiled."""
    return lb.load_program(name)


@lru_cache
def evidence(name: str, seed: int = 0) -> comparison.Evidence:
    return comparison.estimate_evidence(program(name), case().arguments(), case().data, seed=seed)


# --- evidence -------------------------------------------------------------------------------------


@pytest.mark.long
@pytest.mark.parametrize("name", ["sky_marginal", "prior_amplitude"])
def test_the_evidence_is_that_of_brute_force(name):
    """Within 5 of the errors it gives itself; the grids are exact to 1e-5."""
    if name == "sky_marginal":
        expected = log_integral(level_grid(), LEVELS)
    else:
        expected = log_integral(spectrum_grid(), AMPLITUDES, TILTS)
    found = [evidence(name, seed) for seed in (0, 1)]
    assert found[0].log_evidence != found[1].log_evidence
    for got in found:
        assert got.error < 0.1
        assert abs(got.log_evidence - expected) < 5 * got.error
        # nearly Gaussian posteriors, of which Laplace's approximation is already good
        assert abs(float(got.laplace.log_evidence) - expected) < 0.2
    # and the other program's is not it
    other = evidence("prior_amplitude" if name == "sky_marginal" else "sky_marginal")
    assert abs(other.log_evidence - expected) > 5 * found[0].error


@pytest.mark.long
@pytest.mark.parametrize(("name", "least"), [("sky_marginal", 0.8), ("prior_amplitude", 0.6)])
def test_how_many_draws_count(name, least):
    """A Student t of 7 degrees for a Gaussian: <w>^2 / <w^2> is 0.97 in one dimension, 0.94 in two.

    Two thirds of that are left for what is not Gaussian. The error is the scatter of the weights,
    (n / effective - 1) / (n - 1), by the definition of both.
    """
    got = evidence(name)
    assert least * 400 < got.effective <= 400
    assert got.error**2 == pytest.approx((400 / got.effective - 1) / 399, rel=1e-6)


# --- the mode -------------------------------------------------------------------------------------


@pytest.mark.long
def test_the_mode_and_the_curvature_in_two_dimensions():
    it = evidence("prior_amplitude").laplace
    names = [name for name, _ in it.whitening.sites]
    order = [names.index("amplitude"), names.index("tilt")]
    mode = np.asarray(it.whitening.mean)[order]
    h = 1e-3

    def p(*off):
        return log_spectrum(*(mode + h * np.asarray(off)))

    slope = np.array([p(1, 0) - p(-1, 0), p(0, 1) - p(0, -1)]) / (2 * h)
    cross = (p(1, 1) - p(1, -1) - p(-1, 1) + p(-1, -1)) / 4
    twice = [p(1, 0) - 2 * p(0, 0) + p(-1, 0), p(0, 1) - 2 * p(0, 0) + p(0, -1)]
    curvature = -np.array([[twice[0], cross], [cross, twice[1]]]) / h**2
    root = np.asarray(it.whitening.root)[order]
    # the gradient there, in standard deviations, is what is left to the mode
    assert np.sqrt(((root.T @ slope) ** 2).mean()) < 0.01
    np.testing.assert_allclose(root.T @ curvature @ root, np.eye(2), rtol=0, atol=0.03)
    # no grid node is above it
    assert spectrum_grid().max() <= p(0, 0) + 1e-4


def test_where_there_is_no_mode_nothing_is_found():
    """A density that grows for ever: neither a mode, nor anything made up."""

    def model(data=None):
        x = numpyro.sample("x", dist.Normal(jnp.zeros(()), 1.0))
        numpyro.factor("ever more", 0.1 * (x - 1.0) ** 4)

    assert not bool(laplace_approximation(model, {"data": None}).converged)
    endless = Program("endless", model, "")
    refuse("no mode of the posterior", comparison.estimate_evidence, endless, {}, np.zeros(1))


# --- leaving one out ------------------------------------------------------------------------------


def left_out(d, mean, covariance) -> np.ndarray:
    """ln p(d_i | others) = ln p(d) - ln p(others), by scipy."""
    rows = []
    for i in range(len(d)):
        rest = np.delete(np.arange(len(d)), i)
        others = log_normal(d[rest], covariance[np.ix_(rest, rest)], mean[rest])
        rows.append(log_normal(d, covariance, mean) - others)
    return np.array(rows)


@pytest.mark.long
@pytest.mark.parametrize("shifted", [False, True])
@pytest.mark.parametrize("n_data", [30, 5])
def test_leaving_one_datum_out(n_data, shifted):
    """More data than modes (map form) and fewer (data form), with an offset and without.

    K has condition below 1e4, and the log densities below 1e3: 1e-9 of them.
    """
    it = Case.drawn(SPECTRUM, n_data, n_data, 2.0)
    offset = np.linspace(-3.0, 5.0, n_data) if shifted else np.zeros(n_data)
    sky = jnp.asarray(np.random.default_rng(0).normal(size=9))
    model = lb.LinearGaussian(
        jnp.asarray(it.a),
        lb.HarmonicPrior(jnp.asarray(it.base)),
        DenseCovariance(jnp.asarray(it.n)),
        jnp.asarray(offset) if shifted else None,
    )
    assert (model.factorise().basis is None) == (n_data == 30)
    got = lb.Marginal(model).leave_one_out(jnp.asarray(it.data))
    expected = left_out(it.data, offset, it.seen() + it.n)
    np.testing.assert_allclose(got, expected, rtol=1e-9, atol=1e-9)
    for noise in (model.noise, model.noise.factor()):
        given = lb.CorrelatedNormal(model.predict(sky), noise)
        expected = left_out(it.data, it.a @ np.asarray(sky) + offset, it.n)
        got = given.leave_one_out(jnp.asarray(it.data))
        np.testing.assert_allclose(got, expected, rtol=1e-9, atol=1e-9)


def test_independent_data_are_predicted_by_their_own_densities():
    sigma = np.array([0.5, 1.0, 3.0])
    given = lb.CorrelatedNormal(jnp.zeros(3), lb.DiagonalCovariance(jnp.asarray(sigma**2)))
    d = np.array([0.1, -2.0, 4.0])
    expected = norm.logpdf(d, 0.0, sigma)
    np.testing.assert_allclose(given.leave_one_out(jnp.asarray(d)), expected, rtol=1e-13)


# --- comparison -----------------------------------------------------------------------------------


def drawn(log_p, name, nodes, n=(2, 300)) -> dict[str, np.ndarray]:
    """Independent draws (chains, draws) from a density on a grid; the site is exp(x)."""
    weights = np.exp(log_p - log_p.max())
    rng = np.random.default_rng(11)
    return {name: np.exp(rng.choice(nodes, n, p=weights / weights.sum()))}


def tree(sites):
    return arviz_base.from_dict(
        {"posterior": sites, "observed_data": {"data": case().data}}, check_conventions=False
    )


@lru_cache
def free_tree():
    return tree(drawn(level_grid(), "noise_level", LEVELS))


@pytest.mark.long
@pytest.mark.essential
def test_the_likelihoods_of_every_draw():
    """Of each draw its own, of every third draw so that at most 200 are left."""
    marginal = program("sky_marginal")
    found = comparison.with_log_likelihood(free_tree(), marginal, case().arguments(), most=200)
    rows = found["log_likelihood"]["data"]
    assert rows.dims == ("chain", "draw", "datum") and rows.shape == (2, 100, 30)
    levels = found["posterior"]["noise_level"].values
    np.testing.assert_array_equal(levels, free_tree()["posterior"]["noise_level"].values[:, ::3])
    for chain, draw in [(0, 0), (1, 41), (1, 99)]:
        covariance = case().seen() + levels[chain, draw] * case().n
        expected = left_out(case().data, np.zeros(30), covariance)
        np.testing.assert_allclose(rows.values[chain, draw], expected, rtol=1e-9, atol=1e-9)
    # all are kept where there are no more than asked for
    whole = comparison.with_log_likelihood(free_tree(), marginal, case().arguments(), most=600)
    assert whole["log_likelihood"]["data"].shape == (2, 300, 30)
    few = comparison.with_log_likelihood(free_tree(), marginal, case().arguments(), most=7)
    n_chains, n_draws, _ = few["log_likelihood"]["data"].shape
    assert n_chains * n_draws <= 7


@pytest.mark.long
def test_the_right_program_is_ranked_first():
    """Noise four times stronger than N says: the free level predicts better, the evidence agrees.

    A datum's squared residual is 4 on average instead of 1, of which ln p takes half: 1.5 each less
    than ln(4) / 2 = 0.7 that the broader density costs. The sky takes some of it.
    """
    fixed, free = Program("fixed", fixed_noise, ""), program("sky_marginal")
    arguments = case().arguments()
    amplitudes = np.array([case().given(np.exp(x)).log_prob for x in AMPLITUDES])
    amplitudes += norm.logpdf(AMPLITUDES, 0, 0.5)
    trees = {
        "fixed": comparison.with_log_likelihood(
            tree(drawn(amplitudes, "amplitude", AMPLITUDES)), fixed, arguments
        ),
        "free": comparison.with_log_likelihood(free_tree(), free, arguments),
    }
    table = comparison.compare_programs(trees)
    assert list(table.index) == ["free", "fixed"]
    assert list(table["rank"]) == [0, 1]
    # by half a unit or more for each of the 30 data
    assert float(table["elpd"]["free"] - table["elpd"]["fixed"]) > 5.0
    got = comparison.estimate_evidence(fixed, arguments, case().data)
    assert got.log_evidence < evidence("sky_marginal").log_evidence - 5.0
    # the other way round where N is right
    plain = case(level=1.0)
    free_one, fixed_one = (
        comparison.estimate_evidence(asked, arguments, plain.data) for asked in (free, fixed)
    )
    assert abs(free_one.log_evidence - fixed_one.log_evidence) < 5.0


def test_other_distributions_cannot_be_compared():
    def model(data=None):
        level = numpyro.sample("noise_level", dist.LogNormal(0.0, 1.0))
        numpyro.sample("data", dist.Normal(jnp.zeros(30), level).to_event(1), obs=data)

    program = Program("independent", model, "")
    refuse(
        "follow Independent;.* Marginal or",
        comparison.with_log_likelihood,
        free_tree(),
        program,
        {},
    )
