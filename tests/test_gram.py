"""The lower triangle of W^T W against numpy."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lusee_bayes.gram import gram


@pytest.mark.parametrize("columns", [1, 2, 3, 4, 5, 6, 7, 8, 31, 64])
@pytest.mark.parametrize("rows", [1, 20])
def test_lower_triangle(rows, columns):
    w = np.random.default_rng(columns).normal(size=(rows, columns))
    got = np.asarray(jax.jit(gram)(jnp.asarray(w)))
    assert got.shape == (columns, columns)
    # a sum of `rows` products of order one: rounding below rows x eps x |w|^2 = 20 x 2e-16 x 10
    np.testing.assert_allclose(np.tril(got), np.tril(w.T @ w), rtol=0, atol=1e-13)
