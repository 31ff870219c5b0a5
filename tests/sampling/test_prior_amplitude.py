"""The program prior_amplitude against its density on a grid.

The oracle knows the model from its docstring only: d ~ N(0, A S A^T + N), S = diag(C_ell) with
C_ell = spectrum A ((ell + 1) / 10)^tilt, ln A ~ N(0, 0.5^2), tilt ~ N(0, 0.5^2).
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from experiments import density
from scipy.stats import lognorm, norm
from small_models import Case, assert_mean

import lusee_bayes as lb
from lusee_bayes.sampling.programs import collapsed_draws

PROGRAM = lb.load_program("prior_amplitude")


class Grid:
    """p(amplitude, tilt | d) by brute force, and what follows from it."""

    def __init__(self, case: Case, log_amplitude, tilt):
        self.log_amplitude, self.tilt = log_amplitude, tilt
        x, t = (g.ravel() for g in np.meshgrid(log_amplitude, tilt, indexing="ij"))
        skies = [case.given(np.exp(xi), ti) for xi, ti in zip(x, t, strict=True)]
        log_p = np.array([sky.log_prob for sky in skies])
        log_p += norm.logpdf(x, 0.0, 0.5) + norm.logpdf(t, 0.0, 0.5)
        weights = np.exp(log_p - log_p.max())
        self.weights = weights / weights.sum()
        square = self.weights.reshape(len(log_amplitude), len(tilt))
        # what is cut off at the edges is less than can be seen
        edges = [square[0], square[-1], square[:, 0], square[:, -1]]
        assert max(edge.sum() for edge in edges) < 1e-5
        self.marginals = square.sum(1), square.sum(0)
        points = np.stack([x, t])
        self.mean = points @ self.weights
        delta = points - self.mean[:, None]
        self.covariance = (delta * self.weights) @ delta.T
        means = np.stack([sky.mean for sky in skies])
        self.sky_mean = self.weights @ means
        self.variance_of_means = self.weights @ (means - self.sky_mean) ** 2
        self.mean_variance = self.weights @ np.stack([np.diag(s.covariance) for s in skies])

    def cdf(self, which, values):
        """Marginal distribution function of ln amplitude (0) or tilt (1)."""
        nodes = (self.log_amplitude, self.tilt)[which]
        # the weight of a node is that of a cell around it
        edges = np.append(nodes, 2 * nodes[-1] - nodes[-2]) - 0.5 * (nodes[1] - nodes[0])
        return np.interp(values, edges, np.append(0.0, np.cumsum(self.marginals[which])))


# --- against a grid -------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def case():
    """40 data of a sky with 25 modes, twice as bright as A = 1; correlated noise as strong."""
    return Case.drawn(4.0 / (1.0 + np.arange(5)), 40, 5, 15.0, amplitude=2.0, tilt=0.3)


# a third of a standard deviation apart: sums over smooth densities are exact to 1e-10 there
LOG_AMPLITUDES, TILTS = np.linspace(-2.4, 3.4, 47), np.linspace(-3.2, 2.6, 47)


@pytest.fixture(scope="module")
def grid(case):
    return Grid(case, LOG_AMPLITUDES, TILTS)


@pytest.fixture(scope="module")
def sites(case):
    """4 x 1500 draws by NUTS, of which about a third count."""
    arguments = case.arguments() | {"data": jnp.asarray(case.data)}
    chains = lb.sample(PROGRAM.model, arguments, lb.Sampler(draws=1500, seed=1))
    assert not chains.statistics["diverging"].any()
    return chains.sites


def test_the_density_is_the_priors_times_the_evidence(case):
    """Also where the prior makes it small. The oracle inverts K, with condition 1e4: 1e-11."""
    for amplitude, tilt in [(1.0, 0.0), (0.2, -1.0), (6.0, 1.3)]:
        expected = case.given(amplitude, tilt).log_prob
        expected += lognorm.logpdf(amplitude, 0.5) + norm.logpdf(tilt, 0.0, 0.5)
        arguments = case.arguments() | {"data": jnp.asarray(case.data)}
        got, _ = density(PROGRAM, arguments, {"amplitude": amplitude, "tilt": tilt})
        assert got == pytest.approx(expected, rel=1e-11)


@pytest.mark.long
def test_nuts_follows_the_grid(grid, sites):
    draws = np.stack([np.log(sites["amplitude"]), sites["tilt"]], -1)
    delta, (i, j) = draws - grid.mean, np.triu_indices(2)
    assert_mean(delta, 0.0, "mean", slack=1.0)
    assert_mean(delta[..., i] * delta[..., j], grid.covariance[i, j], "moments", slack=1.0)
    for q in (0.1, 0.9):
        below = np.stack([grid.cdf(k, draws[..., k]) < q for k in (0, 1)], -1)
        assert_mean(below.astype(float), q, "quantiles", slack=1.0)


# --- the skies drawn with it ----------------------------------------------------------------------


@pytest.mark.essential
def test_skies_obey_the_law_of_total_variance(case, grid, sites):
    """Mean of the conditional variances plus variance of the conditional means, mode by mode."""
    total = grid.mean_variance + grid.variance_of_means
    skies = collapsed_draws(PROGRAM, case.arguments(), case.data, sites, jax.random.key(2))
    delta = skies - grid.sky_mean
    squares = np.concatenate([delta**2, (delta**2).sum(2, keepdims=True)], axis=2)
    assert_mean(delta, 0.0, "mean", slack=1.0)
    assert_mean(squares, np.append(total, total.sum()), "variance", slack=1.0)
