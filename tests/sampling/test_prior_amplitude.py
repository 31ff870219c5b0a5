"""The program prior_amplitude against its density on a grid.

The oracle knows the model from its docstring only: d ~ N(0, A S A^T + N), S = diag(C_ell) with
C_ell = spectrum A ((ell + 1) / 10)^tilt, ln A ~ N(0, 0.5^2), tilt ~ N(0, 0.5^2).
"""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from arviz_stats.base import array_stats
from experiments import density
from reference_linear import posterior, random_covariance, z_of
from scipy.stats import lognorm, norm

import lusee_bayes as lb
from lusee_bayes.noise.covariance import DenseCovariance
from lusee_bayes.sampling.programs import collapsed_draws

PROGRAM = lb.load_program("prior_amplitude")


def ell_of_mode(lmax):
    return np.repeat(np.arange(lmax + 1), 2 * np.arange(lmax + 1) + 1)


def spectrum_of(base, amplitude, tilt):
    """C_ell, (..., ells) for amplitudes and tilts (...)."""
    ell = np.arange(len(base))
    amplitude, tilt = np.asarray(amplitude)[..., None], np.asarray(tilt)[..., None]
    return base * amplitude * ((ell + 1) / 10) ** tilt


@dataclass(frozen=True, eq=False)
class Case:
    """A small model as dense matrices, with data."""

    a: np.ndarray
    base: np.ndarray
    n: np.ndarray
    data: np.ndarray

    @property
    def lmax(self) -> int:
        return len(self.base) - 1

    def given(self, amplitude, tilt):
        """Textbook posterior of the sky, with the evidence, at fixed amplitude and tilt."""
        variance = spectrum_of(self.base, amplitude, tilt)[ell_of_mode(self.lmax)]
        return posterior(self.a, np.diag(variance), self.n, self.data)

    def arguments(self):
        """What the program is called with."""
        return {
            "coupling": jnp.asarray(self.a),
            "offset": jnp.zeros(len(self.a)),
            "prior": lb.HarmonicPrior(jnp.asarray(self.base)),
            "noise": DenseCovariance(jnp.asarray(self.n)),
            "data": jnp.asarray(self.data),
        }


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


def ess(x) -> float:
    """Effective size of draws (chains, draws), for their mean."""
    return float(array_stats.ess(x, chain_axis=0, draw_axis=1, method="mean"))


def assert_follow(grid: Grid, log_amplitude, tilt):
    """Moments and quantiles of draws (chains, draws), to z_of(9) Monte Carlo errors."""
    limit = z_of(9)
    z = np.stack([log_amplitude, tilt]) - grid.mean[:, None, None]
    std = np.sqrt(np.diag(grid.covariance))
    for i in range(2):
        error = std[i] / np.sqrt(ess(z[i]))
        assert abs(z[i].mean()) < limit * error, f"mean of {i} off"
        for j in range(i + 1):
            product = z[i] * z[j]
            error = product.std() / np.sqrt(ess(product))
            assert abs(product.mean() - grid.covariance[i, j]) < limit * error, f"moment {i}{j} off"
    for i, draws in enumerate((log_amplitude, tilt)):
        for q in (0.1, 0.9):
            below = (grid.cdf(i, draws) < q).astype(float)
            error = np.sqrt(q * (1 - q) / ess(below))
            assert abs(below.mean() - q) < limit * error, f"quantile {q} of {i} off"


# --- against a grid -------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def case():
    """40 data of a sky with 25 modes, twice as bright as A = 1; correlated noise as strong."""
    rng = np.random.default_rng(5)
    a, base = rng.normal(size=(40, 25)), 4.0 / (1.0 + np.arange(5))
    n = 15.0 * random_covariance(rng, 40)
    sky = np.sqrt(spectrum_of(base, 2.0, 0.3)[ell_of_mode(4)]) * rng.normal(size=25)
    return Case(a, base, n, a @ sky + np.linalg.cholesky(n) @ rng.normal(size=40))


# a third of a standard deviation apart: sums over smooth densities are exact to 1e-10 there
LOG_AMPLITUDES, TILTS = np.linspace(-2.4, 3.4, 47), np.linspace(-3.2, 2.6, 47)


@pytest.fixture(scope="module")
def grid(case):
    return Grid(case, LOG_AMPLITUDES, TILTS)


@pytest.fixture(scope="module")
def sites(case):
    """4 x 1500 draws by NUTS, of which about a third count."""
    chains = lb.sample(PROGRAM.model, case.arguments(), lb.Sampler(draws=1500, seed=1))
    assert not chains.statistics["diverging"].any()
    return chains.sites


def test_the_density_is_the_priors_times_the_evidence(case):
    """Also where the prior makes it small. The oracle inverts K, with condition 1e4: 1e-11."""
    for amplitude, tilt in [(1.0, 0.0), (0.2, -1.0), (6.0, 1.3)]:
        expected = case.given(amplitude, tilt).log_prob
        expected += lognorm.logpdf(amplitude, 0.5) + norm.logpdf(tilt, 0.0, 0.5)
        got, _ = density(PROGRAM, case.arguments(), {"amplitude": amplitude, "tilt": tilt})
        assert got == pytest.approx(expected, rel=1e-11)


@pytest.mark.long
def test_nuts_follows_the_grid(grid, sites):
    assert_follow(grid, np.log(sites["amplitude"]), sites["tilt"])


# --- the skies drawn with it ----------------------------------------------------------------------


def assert_variances(skies, mean, variance):
    """Of every mode about the mean given, and their sum, to z_of Monte Carlo errors."""
    limit = z_of(2 * len(mean) + 1)
    delta = skies - mean
    squares = np.concatenate([delta**2, (delta**2).sum(2, keepdims=True)], axis=2)
    for values, expected, what in [
        (delta, np.zeros(len(mean)), "mean"),
        (squares, np.append(variance, variance.sum()), "variance"),
    ]:
        for i in range(values.shape[2]):
            error = values[..., i].std() / np.sqrt(ess(values[..., i]))
            assert abs(values[..., i].mean() - expected[i]) < limit * error, f"{what} of {i} off"


@pytest.mark.long
@pytest.mark.essential
def test_skies_obey_the_law_of_total_variance(case, grid, sites):
    """Mean of the conditional variances plus variance of the conditional means, mode by mode."""
    total = grid.mean_variance + grid.variance_of_means
    arguments = case.arguments()
    data = arguments.pop("data")
    skies = collapsed_draws(PROGRAM, arguments, data, sites, jax.random.key(2))
    assert_variances(skies, grid.sky_mean, total)
