"""The contract of covariances."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from scipy.stats import norm

from lusee_bayes.noise.covariance import Covariance

# condition numbers stay below 1e3, so a backward stable solve is good to 1e3 x 16 eps = 4e-12
TOL = 1e-11
# chance that draws which are right fail
FALSE_ALARM = 1e-4


def close(got: object, expected: object, tol: float = TOL) -> None:
    """Assert that arrays agree to a part of the largest entry."""
    expected = np.asarray(expected)
    np.testing.assert_allclose(got, expected, rtol=0, atol=tol * np.abs(expected).max())


@eqx.filter_jit
def _numbers(cov: Covariance, x, xs, factor_of_cov):
    """All that the contract compares, compiled once for every structure."""
    factor = cov.factor()
    unit = jnp.eye(cov.size)
    return {
        "dense": cov.dense(),
        "diagonal": cov.diagonal(),
        "log_det": (cov.log_det(), factor.log_det(), factor_of_cov.log_det()),
        "mv": [cov.mv(v) for v in (x, xs)],
        "solve": [f.solve(v) for f in (factor, factor_of_cov) for v in (x, xs)],
        "solve_of_cov": cov.solve(xs),
        "back": factor_of_cov.whiten(factor_of_cov.colour(xs)),
        "root": factor_of_cov.colour(unit),
        "inverse_root": factor_of_cov.whiten(unit),
        "inverse_root_transpose": factor_of_cov.whiten_transpose(unit),
        "one": [f(x) for f in (factor.colour, factor.whiten, factor.whiten_transpose)],
        "mapped": jax.vmap(lambda v: cov.solve(v))(xs.T),
        "scaled": (cov.scaled(2.5).dense(), cov.scaled(jnp.asarray(2.5)).solve(x)),
        "scaled_log_dets": jax.vmap(lambda s: cov.scaled(s).log_det())(jnp.asarray([1.0, 2.5])),
        "draws": cov.sample(jax.random.key(2), 20_000),
    }


@eqx.filter_jit
def _slopes(cov: Covariance, x):
    """d ln|s N| / ds at s = 2, d(x^T N^-1 x) / dx, and d(x^T (s N)^-1 x) / ds at s = 2."""
    two = jnp.asarray(2.0)
    return (
        jax.grad(lambda s: cov.scaled(s).log_det())(two),
        jax.grad(lambda v: v @ cov.solve(v))(x),
        jax.grad(lambda s: x @ cov.scaled(s).solve(x))(two),
    )


def check_covariance(
    cov: Covariance, dense: np.ndarray, *, slopes: bool = True, eager: bool = False
) -> None:
    """Check what it means to be a Covariance: everything agrees with a matrix.

    Parameters
    ----------
    cov : Covariance
    dense : (data, data) array
        The same matrix, by hand; its condition number has to stay below 1e3.
    slopes : bool
        Check derivatives, too.
    eager : bool
        Check outside of ``jax.jit``, too.

    Raises
    ------
    AssertionError
        If something disagrees.
    """
    rng = np.random.default_rng(7)
    n = len(dense)
    x, xs = rng.normal(size=n), rng.normal(size=(n, 3))
    inverse, (sign, log_det) = np.linalg.inv(dense), np.linalg.slogdet(dense)
    assert sign == 1.0
    assert cov.size == n
    factor = cov.factor()  # outside of jit, where values are checked
    if eager:
        close(cov.solve(jnp.asarray(x)), inverse @ x)
        close(jax.jit(lambda v: cov.solve(v))(jnp.asarray(x)), inverse @ x)  # closed over
        assert cov.sample(jax.random.key(1)).shape == (n,)
    got = _numbers(cov, jnp.asarray(x), jnp.asarray(xs), factor)

    # what it is
    close(got["dense"], dense, 1e-15)
    assert (np.asarray(got["dense"]) == np.asarray(got["dense"]).T).all()
    close(got["diagonal"], np.diag(dense), 1e-15)
    for value in got["log_det"]:
        np.testing.assert_allclose(value, log_det, rtol=0, atol=TOL * n)
    for value, v in zip(got["mv"], (x, xs), strict=True):
        close(value, dense @ v)
    for value, v in zip(got["solve"], 2 * (x, xs), strict=True):
        close(value, inverse @ v)
    close(got["solve_of_cov"], inverse @ xs)
    close(got["mapped"], xs.T @ inverse)

    # the square root: L L^T = N, whiten = L^-1, whiten_transpose = L^-T
    root = np.asarray(got["root"])
    close(root @ root.T, dense)
    close(got["inverse_root"], np.linalg.inv(root))
    close(got["inverse_root_transpose"], np.linalg.inv(root).T)
    close(got["back"], xs)
    for value, matrix in zip(
        got["one"], (root, np.linalg.inv(root), np.linalg.inv(root).T), strict=True
    ):
        close(value, matrix @ x)

    # scaled
    close(got["scaled"][0], 2.5 * dense)
    close(got["scaled"][1], inverse @ x / 2.5)
    close(got["scaled_log_dets"], [log_det, log_det + n * np.log(2.5)])

    # draws
    assert jax.eval_shape(cov.sample, jax.random.key(1)).shape == (n,)
    assert got["draws"].shape == (20_000, n)
    _assert_draws_follow(np.asarray(got["draws"]), dense)

    if slopes:
        check_slopes(cov, dense)


def check_slopes(cov: Covariance, dense: np.ndarray) -> None:
    """Check the derivatives of a covariance against those of a matrix."""
    x = np.random.default_rng(8).normal(size=len(dense))
    of_log_det, of_vector, of_scale = _slopes(cov, jnp.asarray(x))
    inverse = np.linalg.inv(dense)
    np.testing.assert_allclose(of_log_det, len(dense) / 2.0, rtol=TOL)
    close(of_vector, 2.0 * inverse @ x)
    np.testing.assert_allclose(of_scale, -x @ inverse @ x / 4.0, rtol=TOL)


def _assert_draws_follow(draws: np.ndarray, covariance: np.ndarray) -> None:
    """Second moments of draws (draws, entries) scatter by sqrt((C_ii C_jj + C_ij^2) / n) (Wick)."""
    variance = np.diag(covariance)
    for found, expected, scatter in (
        (draws.mean(0), 0.0, np.sqrt(variance)),
        (
            draws.T @ draws / len(draws),
            covariance,
            np.sqrt(np.outer(variance, variance) + covariance**2),
        ),
    ):
        worst = np.abs(found - expected) / scatter * np.sqrt(len(draws))
        assert worst.max() < norm.isf(FALSE_ALARM / (2 * worst.size))
