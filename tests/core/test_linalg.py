"""Products, factors and inverses of symmetric matrices against numpy."""

import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from decimal import localcontext
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from assertions import refuse
from commands import python
from reference_linear import exact
from scipy.linalg.lapack import dpotri

from lusee_bayes.core import linalg as la


def spd(n: int, *batch: int) -> np.ndarray:
    """Symmetric positive definite matrices of full rank."""
    a = np.random.default_rng(n).standard_normal((*batch, n, 2 * n + 3))
    return a @ a.swapaxes(-1, -2) / n


ARRAYS = pytest.mark.parametrize("xp", [np, jnp], ids=["numpy", "jax"])


# as many columns as blocks, fewer, and numbers that do not split evenly
@pytest.mark.parametrize("columns", [1, la.N_BLOCKS - 1, la.N_BLOCKS, la.N_BLOCKS + 1, 31])
@pytest.mark.parametrize("rows", [1, 20])
def test_gram_matrix(rows, columns):
    w = np.random.default_rng(columns).normal(size=(rows, columns))
    got = np.asarray(jax.jit(la.gram_matrix)(jnp.asarray(w)))
    np.testing.assert_array_equal(got, got.T)
    # a sum of `rows` products of order one: rounding below rows x eps x |w|^2 = 20 x 2e-16 x 10
    np.testing.assert_allclose(got, w.T @ w, rtol=0, atol=1e-13)


@ARRAYS
def test_symmetric_product(xp):
    """A B with B = S A^T, which is symmetric without either being the other's transpose."""
    a, s = np.random.default_rng(1).normal(size=(13, 7)), spd(7)
    got = np.asarray(la.symmetric_product(xp.asarray(a), xp.asarray(s @ a.T)))
    np.testing.assert_array_equal(got, got.T)
    np.testing.assert_allclose(got, a @ s @ a.T, rtol=0, atol=1e-13 * np.abs(got).max())


@pytest.mark.parametrize("n", [1, 7, 161, 643])
@ARRAYS
def test_inverses_of_triangles(n, xp):
    matrix = spd(n)
    lower = np.linalg.cholesky(matrix)
    inverse = la.invert_lower(xp.asarray(lower + np.triu(np.ones((n, n)), 1)))
    np.testing.assert_allclose(np.asarray(inverse) @ lower, np.eye(n), rtol=0, atol=1e-11)
    whole = np.asarray(la.inverse_from_cholesky(xp.asarray(lower)))
    np.testing.assert_array_equal(whole, whole.T)
    np.testing.assert_allclose(whole @ matrix, np.eye(n), rtol=0, atol=1e-10)


@pytest.mark.parametrize("batch", [(), (3,)])
@pytest.mark.parametrize("transpose", [False, True])
def test_solve_lower(batch, transpose):
    lower = np.linalg.cholesky(spd(6, *batch))
    x = np.random.default_rng(2).normal(size=(*batch, 6, 2))
    got = np.asarray(la.solve_lower(jnp.asarray(lower), jnp.asarray(x), transpose=transpose))
    matrix = lower.swapaxes(-1, -2) if transpose else lower
    np.testing.assert_allclose(matrix @ got, x, rtol=0, atol=1e-13)


@pytest.mark.parametrize("batch", [(), (3,)])
def test_checked_cholesky(batch):
    matrix = spd(6, *batch)
    got = la.checked_cholesky("N", jnp.asarray(matrix))
    np.testing.assert_allclose(np.tril(got), np.linalg.cholesky(matrix), rtol=0, atol=1e-13)


def test_checked_cholesky_names_what_has_no_factor():
    """One of a stack is enough; its lowest eigenvalue is 1 - 2."""
    stack = jnp.asarray([np.eye(2), [[1.0, 2.0], [2.0, 1.0]]])
    words = "the noise is .* eigenvalue is -1 .largest entry 2"
    refuse(words, la.checked_cholesky, "the noise", stack)
    # values are not known there
    assert np.isnan(jax.jit(lambda m: la.checked_cholesky("the noise", m))(stack)[1]).any()


def test_batched_solves_side_by_side_end():
    """In some versions of jaxlib such calls wait for each other for ever; none of them fits."""
    program = (
        "import sys; import jax, jax.numpy as jnp; import lusee_bayes\n"
        "a = jnp.eye(60) + jnp.tril(jnp.full((64, 60, 60), 0.01))\n"
        "f = jax.vmap(lambda a: [jax.scipy.linalg.solve_triangular(a * k, a, lower=True)\n"
        "                        for k in range(1, 9)])\n"
        "print([float(jnp.abs(x - jnp.eye(60) / k).max()) < 1e-14\n"
        "       for _ in range(10) for k, x in enumerate(jax.jit(f)(a), 1)].count(True))"
    )
    done = python("-c", program, timeout=60, check=False)
    assert done.stdout == "80\n", done.stderr


def test_factors_are_clean_and_in_place_on_request():
    """L alone, whatever stands above the diagonal; a matrix stays unless it may be overwritten."""
    matrix = spd(40)
    given = matrix + np.triu(np.full((40, 40), np.nan), 1)
    kept, lower = given.copy(), la.cholesky(given)
    np.testing.assert_allclose(lower @ lower.T, matrix, rtol=0, atol=1e-13)
    np.testing.assert_array_equal(given, kept)
    assert la.cholesky(given, overwrite=True) is given
    np.testing.assert_array_equal(given, lower)
    assert np.isnan(la.cholesky(-matrix)).all()


def longest_pause(work: Callable[[], None]) -> float:
    """The longest time for which this thread stood still while another worked, over the work's."""
    start = before = time.perf_counter()
    longest = 0.0
    with ThreadPoolExecutor(1) as pool:
        done = pool.submit(work)
        while not done.done():
            now = time.perf_counter()
            longest, before = max(longest, now - before), now
    return longest / (before - start)


def test_other_threads_go_on_meanwhile():
    """The interpreter's lock is free while LAPACK works; SciPy's own wrapper keeps it."""
    lower = np.eye(2000)
    ours = min(longest_pause(partial(la.inverse_from_cholesky, lower)) for _ in range(3))
    # on a busy machine less than all of its time
    assert ours < 0.5 * max(longest_pause(partial(dpotri, lower.T, lower=0)) for _ in range(3))


@ARRAYS
@pytest.mark.parametrize("n", [5, 80])
def test_products_with_a_triangle(n, xp):
    rng = np.random.default_rng(n)
    lower, matrix, x = np.tril(rng.normal(size=(n, n))), spd(n), rng.normal(size=(70, n))
    low, middle, rows = (xp.asarray(a) for a in (lower, matrix, x))
    close = partial(np.testing.assert_allclose, rtol=0, atol=1e-12 * n)
    close(la.times_lower(rows, low, transpose=False), x @ lower)
    close(la.times_lower(rows, low, transpose=True), x @ lower.T)
    for sandwich, left in ((la.sandwich, lower.T), (la.outer_sandwich, lower)):
        found = sandwich(middle, low)
        close(found, left @ matrix @ left.T)
        np.testing.assert_array_equal(found, np.asarray(found).T)
    root = np.linalg.cholesky(spd(n + 1)[:n, :n])
    inverse = np.linalg.inv(root)
    root, matrix = xp.asarray(root), xp.asarray(matrix)
    close(la.inverse_sandwich(matrix, root), inverse @ matrix @ inverse.T)
    close(la.inverse_sandwich(matrix, root, transpose=True), inverse.T @ matrix @ inverse)


@ARRAYS
def test_a_residual_of_large_numbers_is_precise(xp):
    """Rows over twelve orders of magnitude that cancel; the truth in 60 digits."""
    rng = np.random.default_rng(0)
    matrix = rng.normal(size=(40, 40)) * np.geomspace(1.0, 1e12, 40)[:, None]
    x = rng.normal(size=40)
    vector = matrix @ x  # equal up to rounding
    with localcontext(prec=60):
        truth = (exact(vector) - exact(matrix) @ exact(x)).astype(float)
    scale = np.abs(matrix) @ np.abs(x)
    found = la.precise_residual(*(xp.asarray(a) for a in (vector, matrix, x)))
    # 23 bits more than those of a float
    assert (np.abs(found - truth) / scale).max() < 1e-21
    assert (np.abs(vector - np.asarray(matrix @ x) - truth) / scale).max() > 1e-17


def test_few_rows_span_a_matrix():
    """Two kinds of rows, smooth functions of one variable each, that do not help each other."""
    rng, x = np.random.default_rng(0), np.linspace(0.0, 1.0, 150)
    kind = rng.integers(0, 2, 150)
    matrix = np.cos(x[:, None] * np.arange(12.0)) * rng.standard_normal(12)
    picked, factors = la.spanning_rows(matrix, kind)
    assert len(picked) == len(set(picked.tolist())) <= 24
    np.testing.assert_allclose(factors @ matrix[picked], matrix, rtol=0, atol=1e-11)
    assert not factors[kind[:, None] != kind[picked]].any()
    # rows without anything in common need all of them
    rough = rng.standard_normal((20, 30))
    assert sorted(la.spanning_rows(rough, np.zeros(20))[0]) == list(range(20))
