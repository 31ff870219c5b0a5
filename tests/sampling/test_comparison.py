"""Evidences and predictions of programs against brute force: quadrature, and dense Gaussians."""

from functools import lru_cache

import jax.numpy as jnp
import numpy as np
import numpyro
import pytest
from assertions import refuse
from numpyro import distributions as dist
from scipy.stats import norm
from small_models import Case

import lusee_bayes as lb
from lusee_bayes.sampling import mode as comparison
from lusee_bayes.sampling.mode import laplace_approximation
from lusee_bayes.sampling.programs import Program


def log_integral(log_p, *nodes) -> float:
    """Of exp(log_p) over a regular grid, which is exact for smooth densities well inside."""
    weights = np.exp(log_p - log_p.max())
    for axis in range(weights.ndim):
        assert weights.take([0, -1], axis=axis).sum() < 1e-5 * weights.sum()
    return float(log_p.max() + np.log(weights.sum() * np.prod([x[1] - x[0] for x in nodes])))


LEVELS = np.linspace(-5.0, 5.0, 401)
AMPLITUDES, TILTS = np.linspace(-3.0, 3.0, 61), np.linspace(-3.0, 3.0, 61)


SPECTRUM = [4.0, 2.0, 1.0]


@lru_cache
def case(level: float = 4.0) -> Case:
    """Of a sky with 9 modes, and noise whose true level is not one."""
    return Case.drawn(SPECTRUM, 30, 3, 2.0, level)


def log_spectrum(x: float, tilt: float) -> float:
    """ln p(d, x, tilt) of prior_amplitude, x = ln A ~ N(0, 0.5^2) as the tilt."""
    priors = norm.logpdf(x, 0, 0.5) + norm.logpdf(tilt, 0, 0.5)
    return case().given(np.exp(x), tilt).log_prob + priors


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
        # ln p(d, x), x = ln level ~ N(0, 1)
        grid = [case().given(level=np.exp(x)).log_prob + norm.logpdf(x) for x in LEVELS]
        expected = log_integral(np.array(grid), LEVELS)
    else:
        expected = log_integral(spectrum_grid(), AMPLITUDES, TILTS)
    found = [evidence(name, seed) for seed in (0, 1)]
    assert found[0].log_evidence != found[1].log_evidence
    for got in found:
        assert got.error < 0.1 and abs(got.log_evidence - expected) < 5 * got.error
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
    mode, h = np.asarray(it.whitening.mean)[order], 1e-3

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
    refuse("no mode.*posterior", comparison.estimate_evidence, endless, {}, np.zeros(1))
