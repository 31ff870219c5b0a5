"""The contract of priors."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from scipy.stats import norm

from lusee_bayes.core.arrays import on_device, on_host
from lusee_bayes.sky.priors import Prior
from lusee_bayes.testing.refusals import assert_refused

# condition numbers stay below 1e3, so a backward stable solve is good to 1e3 x 16 eps = 4e-12
TOL = 1e-11
# chance that draws which are right fail
FALSE_ALARM = 1e-4
DRAWS = 20_000


def check_prior(prior: Prior, covariance: np.ndarray, mean: np.ndarray | None = None) -> None:
    """Check what it means to be a Prior: everything agrees with a matrix, in NumPy and in JAX.

    Parameters
    ----------
    prior : Prior
    covariance : (unknowns, unknowns) array
        S, by hand; without unknowns of no variance its condition number has to stay below 1e3.
    mean : (unknowns,) array, optional
        The prior mean; zero, if it is not given.

    Raises
    ------
    AssertionError
        If something disagrees.
    """
    n = len(covariance)
    assert prior.size == n
    assert all(isinstance(line, str) for line in prior.description())
    assert prior.independent == bool((covariance == np.diag(np.diag(covariance))).all())
    rng = np.random.default_rng(11)
    u, a = rng.normal(size=(2, 3, prior.rank)), rng.normal(size=(70, n))
    white = rng.normal(size=(prior.rank, prior.rank))
    matrix = rng.normal(size=(n, n))
    inputs = u, a, white @ white.T, matrix @ matrix.T
    found = on_host(eqx.filter_jit(_numbers)(on_device(prior), *map(jnp.asarray, inputs)))
    for name, value in _numbers(on_host(prior), *map(np.array, inputs)).items():
        _close(value, found[name])
    root = found["root"]
    _close(root @ root.T, covariance)
    _close(found["covariance"], covariance)
    _close(found["variance"], np.diag(covariance))
    _close(found["coloured"], u @ root.T)
    _close(found["columns"], a @ root)
    _close(found["sandwich"], root.T @ inputs[3] @ root)
    _close(found["colour_covariance"], root @ inputs[2] @ root.T)
    expected = np.zeros(n) if mean is None else mean
    if prior.invertible:
        _check_inverse(prior, covariance, root, u, a @ root)
    else:
        for refused in (lambda: prior.whiten(a), lambda: prior.whiten_columns(a @ root)):
            assert_refused(refused)
    if prior.white_mean is None:
        assert mean is None
    else:
        _close(prior.colour(prior.white_mean), expected)
    wide = prior.widened(3.0)
    _close(wide.covariance(), 9.0 * covariance)
    if mean is not None:
        _close(wide.colour(wide.white_mean), expected)
    assert prior.sample(jax.random.key(1)).shape == (n,)
    _check_draws(np.asarray(prior.sample(jax.random.key(0), DRAWS)), expected, covariance)


def _numbers(prior: Prior, u, a, white, matrix):
    """All that NumPy and JAX have to agree on."""
    return {
        "root": prior.colour(np.eye(prior.rank)).T,
        "covariance": prior.covariance(),
        "variance": prior.variance(),
        "coloured": prior.colour(u),
        "columns": prior.colour_columns(a),
        "sandwich": prior.sandwich(matrix),
        "colour_covariance": prior.colour_covariance(white),
    }


def _check_inverse(
    prior: Prior, covariance: np.ndarray, root: np.ndarray, u: np.ndarray, columns: np.ndarray
) -> None:
    powerless = np.diag(covariance) == 0
    for one in (on_host(prior), on_device(prior)):
        back = np.asarray(one.whiten(one.colour(u)))
        _close(back, np.where(powerless, 0.0, u))
        _close(one.whiten(one.colour(u[0, 0])), back[0, 0])
        restored = np.asarray(one.whiten_columns(columns))
        _close(restored @ root, columns)
        assert (restored[:, powerless] == 0.0).all()
    if powerless.any():
        assert_refused(prior.require_density)
        assert_refused(prior.log_det)
        return
    prior.require_density()
    np.testing.assert_allclose(prior.log_det(), 0.5 * np.linalg.slogdet(covariance)[1], atol=TOL)


def _close(got: object, expected: object) -> None:
    expected = np.asarray(expected)
    np.testing.assert_allclose(got, expected, rtol=0, atol=TOL * np.abs(expected).max())


def _check_draws(draws: np.ndarray, mean: np.ndarray, covariance: np.ndarray) -> None:
    """Moments of draws scatter by sqrt(C_ii / n), and sqrt((C_ii C_jj + C_ij^2) / n) (Wick)."""
    variance, deviations = np.diag(covariance), draws - mean
    second = np.sqrt(np.outer(variance, variance) + covariance**2)
    for found, expected, scatter in (
        (deviations.mean(0), 0.0, np.sqrt(variance)),
        (deviations.T @ deviations / DRAWS, covariance, second),
    ):
        worst = np.abs(found - expected) * np.sqrt(DRAWS)
        # what has no variance is exact, but for the rounding of a square root
        limit = norm.isf(FALSE_ALARM / (2 * worst.size)) * scatter + 1e-9 * second.max()
        assert (worst < limit).all()
