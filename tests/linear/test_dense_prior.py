"""A prior whose modes are correlated, through all of the closed form.

Three oracles: textbook matrices; the same problem in other coordinates, m' = Q m, A' = A Q^T,
S' = Q S Q^T with an orthogonal Q, whose answers are Q times those of independent modes; and a dense
prior that happens to be diagonal.
"""

from decimal import localcontext
from functools import lru_cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from reference_linear import assert_draws_follow, exact, posterior, random_covariance, solve_exactly
from scipy.stats import multivariate_normal, ortho_group

import lusee_bayes as lb
from lusee_bayes.core.arrays import on_host
from lusee_bayes.linear.information import Information
from lusee_bayes.linear.linear_gaussian import Form, FromInformation, InData, InMap
from lusee_bayes.linear.posterior import Posterior, pixel_std, prior_pixel_std
from lusee_bayes.noise.covariance import DenseCovariance
from lusee_bayes.runs.plan_run import informed_modes
from lusee_bayes.sky.prior import DensePrior

N = 25
RNG = np.random.default_rng(3)
SPECTRUM = np.array([4.0, 1.0, 0.5, 0.25, 0.1])
PER_MODE = np.repeat(SPECTRUM, [1, 3, 5, 7, 9])
MEAN = 3.0 * RNG.normal(size=N)
TURN = ortho_group.rvs(N, random_state=2)
S = TURN * PER_MODE @ TURN.T
# condition numbers below 1e4 x 40 data x eps
CLOSE = 1e-10


def problem(n_data: int, *, turned: bool) -> tuple[lb.LinearGaussian, np.ndarray]:
    """A model and its data, in the coordinates of independent modes or of correlated ones."""
    rng = np.random.default_rng(n_data)
    a, noise = rng.normal(size=(n_data, N)), random_covariance(rng, n_data)
    sky = MEAN + np.sqrt(PER_MODE) * rng.normal(size=N)
    data = a @ sky + np.linalg.cholesky(noise) @ rng.normal(size=n_data)
    if turned:
        prior = DensePrior(jnp.linalg.cholesky(S), mean=jnp.asarray(TURN @ MEAN))
        a = a @ TURN.T
    else:
        prior = lb.HarmonicPrior(jnp.asarray(SPECTRUM), mean=jnp.asarray(MEAN))
    return lb.LinearGaussian(jnp.asarray(a), prior, DenseCovariance(jnp.asarray(noise))), data


@lru_cache
def solved(n_data: int, form: type[Form], *, turned: bool) -> Posterior:
    model, data = problem(n_data, turned=turned)
    return model.condition(jnp.asarray(data), form).posterior


SIZES = [(40, InMap), (40, FromInformation), (12, InData), (12, FromInformation)]


TURNED = [(40, InMap), pytest.param(12, InData, marks=pytest.mark.long)]


@pytest.mark.parametrize(("n_data", "form"), TURNED)
def test_a_turned_problem_has_the_turned_posterior(n_data, form):
    found, expected = (solved(n_data, form, turned=turned) for turned in (True, False))
    covariance = TURN @ np.asarray(expected.covariance()) @ TURN.T
    std = np.linalg.norm(TURN.T @ found.root(), axis=1)
    np.testing.assert_allclose(std, expected.std(), rtol=CLOSE)
    for name in ("information_bits", "prior_chi2"):
        value, wanted = (getattr(p, name)() for p in (found, expected))
        np.testing.assert_allclose(value, wanted, rtol=CLOSE)
    np.testing.assert_allclose(found.prior_fraction(), np.diag(covariance) / np.diag(S), rtol=CLOSE)
    assert informed_modes(found) == informed_modes(expected)


@pytest.mark.parametrize(("n_data", "form"), SIZES)
def test_textbook_matrices_and_scipys_evidence(n_data, form):
    model, data = problem(n_data, turned=True)
    a, noise = np.asarray(model.coupling.dense()), np.asarray(model.noise.dense())
    found = on_host(solved(n_data, form, turned=True))
    answer = posterior(a, S, noise, data - a @ TURN @ MEAN)
    np.testing.assert_allclose(found.mean, answer.mean + TURN @ MEAN, atol=CLOSE)
    np.testing.assert_allclose(found.std(), answer.std, rtol=CLOSE)
    np.testing.assert_allclose(found.covariance(), answer.covariance, atol=CLOSE)
    seen, k = a @ TURN @ MEAN, a @ S @ a.T + noise
    evidence = multivariate_normal.logpdf(data, seen, k)
    np.testing.assert_allclose(found.log_evidence, evidence, rtol=CLOSE)
    chi2 = model.chi2(found.mean, jnp.asarray(data)) + found.prior_chi2()
    np.testing.assert_allclose(chi2, (data - seen) @ np.linalg.solve(k, data - seen), rtol=CLOSE)
    sky = RNG.normal(size=(3, N))
    density = multivariate_normal.logpdf(sky, TURN @ MEAN, S)
    found_density = lb.SkyPrior(model.prior).log_prob(jnp.asarray(sky))
    np.testing.assert_allclose(found_density, density, rtol=CLOSE)
    assert_draws_follow(found.whiten(found.sample(jax.random.key(0), 4000)), np.zeros(N), np.eye(N))
    draws = found.sample(jax.random.key(1), 4000)
    assert_draws_follow(draws, answer.mean + TURN @ MEAN, answer.covariance)


def test_pixels_of_the_prior():
    prior, rest = DensePrior(np.linalg.cholesky(S)), S.copy()
    rest[0] = rest[:, 0] = 0.0
    np.testing.assert_allclose(prior_pixel_std(prior, 4), pixel_std(rest, 4), rtol=1e-12)
    same = lb.HarmonicPrior(SPECTRUM), DensePrior(np.diag(np.sqrt(PER_MODE)))
    np.testing.assert_allclose(*(prior_pixel_std(one, 4) for one in same), rtol=1e-12)


def test_a_mean_far_from_the_reference_sky_is_exact():
    """Signal to noise from 1 to 1e6 in mixed directions; the same equations in 60 digits."""
    rng = np.random.default_rng(1)
    a = rng.normal(size=(60, N)) * np.geomspace(1.0, 1e6, N) @ TURN.T
    other = ortho_group.rvs(N, random_state=3)
    prior = DensePrior(np.linalg.cholesky(other * np.geomspace(1.0, 1e-2, N) @ other.T))
    data = a @ (prior.root @ rng.normal(size=N)) + rng.normal(size=60)
    matrix, vector, zero = a.T @ a, a.T @ data, np.zeros(())
    misfit, n_data = np.asarray(data @ data), np.asarray(60.0)
    found = Information(matrix, vector, np.zeros(N), misfit, zero, n_data).posterior(prior)
    assert float(found.refinement) < 1e-6
    with localcontext(prec=60):
        g, m, v = (exact(x) for x in (prior.root, (matrix + matrix.T) / 2.0, vector))
        u = solve_exactly(g.T @ m @ g + exact(np.eye(N)), (g.T @ v)[:, None])[0][:, 0].astype(float)
    # in posterior standard deviations
    assert np.linalg.norm(found.lower.T @ (found.white_mean - u)) < 1e-6
    # in plain arithmetic the gradient is not good enough
    plain = np.zeros(N)
    for _ in range(5):
        gradient = prior.root.T @ (vector - matrix @ prior.colour(plain)) - plain
        plain = plain + np.linalg.solve(found.lower @ found.lower.T, gradient)
    assert np.linalg.norm(found.lower.T @ (plain - u)) > 1e-5
