"""The contract of coupling matrices."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from lusee_bayes.instrument.coupling import Coupling, DenseCoupling
from lusee_bayes.linear.normal_matrix import normal_matrix
from lusee_bayes.noise.covariance import DiagonalCovariance
from lusee_bayes.testing.refusals import ROUNDING, assert_refused


def check_coupling(coupling: Coupling, dense: Float[np.ndarray, "data unknowns"]) -> None:
    """Check the laws that every coupling matrix obeys.

    Parameters
    ----------
    coupling : Coupling
        Without a response.
    dense : (data, unknowns) array
        The same matrix, made independently.

    Raises
    ------
    AssertionError
        If a law is broken.
    """
    rng = np.random.default_rng(0)
    n_data, n_unknowns = dense.shape
    sky, data = rng.standard_normal(n_unknowns), rng.standard_normal(n_data)
    m, d = jnp.asarray(sky), jnp.asarray(data)

    def same(got, expected):
        atol = ROUNDING * np.abs(expected).max()
        np.testing.assert_allclose(got, expected, rtol=0, atol=atol)

    # A, A m and A^T d are those of the matrix, alone and inside transformations
    assert coupling.shape == dense.shape
    assert coupling.response is None
    same(coupling.dense(), dense)
    same(coupling @ m, dense @ sky)
    same(coupling.transpose_mv(d), dense.T @ data)
    same(jax.jit(lambda a, x: a @ x)(coupling, m), dense @ sky)
    skies = rng.standard_normal((3, n_unknowns))
    same(jax.vmap(lambda x: coupling @ x)(jnp.asarray(skies)), skies @ dense.T)
    slope = jax.grad(lambda x: d @ (coupling @ x))(m)
    same(slope, dense.T @ data)
    assert np.isnan(coupling @ m.at[0].set(jnp.nan)).any()

    # responses multiply the rows, one on top of the other, and sampling goes through them
    first, second = rng.uniform(0.5, 2.0, (2, n_data))
    changed = coupling.with_response(jnp.asarray(first)).with_response(jnp.asarray(second))
    rows = (first * second)[:, None] * dense
    assert changed.shape == dense.shape
    same(changed.response, first * second)
    same(changed.dense(), rows)
    same(changed @ m, rows @ sky)
    same(changed.transpose_mv(d), rows.T @ data)
    slope = jax.grad(lambda r: d @ (coupling.with_response(r) @ m))(jnp.asarray(first))
    same(slope, data * (dense @ sky))

    # a multiple of another matrix is added to A itself, the response stays
    half = jnp.asarray(0.5)
    same(coupling.plus(half, coupling).dense(), 1.5 * dense)
    same(changed.plus(half, coupling).dense(), 1.5 * rows)
    same(changed.plus(half, DenseCoupling(jnp.asarray(dense))) @ m, 1.5 * rows @ sky)
    slope = jax.grad(lambda x: d @ (coupling.plus(x, coupling) @ m))(half)
    same(slope, data @ (dense @ sky))
    assert_refused(lambda: coupling.plus(half, changed))

    # what claims structure in time can be summed without A
    if coupling.has_time_structure:
        variance = rng.uniform(0.5, 2.0, n_data)
        normal = normal_matrix(coupling, DiagonalCovariance(jnp.asarray(variance)))
        same(normal, dense.T @ (dense / variance[:, None]))

    for wrong in (m[1:], m.astype(jnp.float32)):
        assert_refused(lambda x=wrong: coupling @ x)
    for wrong in (d[1:], d.astype(jnp.float32)):
        assert_refused(lambda x=wrong: coupling.transpose_mv(x))
        assert_refused(lambda x=wrong: coupling.with_response(x))
    assert_refused(lambda: coupling.with_response(d.at[0].set(jnp.nan)))
