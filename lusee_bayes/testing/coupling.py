"""The contract of coupling matrices."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from lusee_bayes.instrument.coupling import Coupling, DenseCoupling
from lusee_bayes.linear.normal_matrix import normal_matrix
from lusee_bayes.noise.covariance import DiagonalCovariance
from lusee_bayes.testing.refusals import ROUNDING, assert_refused


@eqx.filter_jit
def _numbers(coupling: Coupling, matrix: DenseCoupling, m, d, skies, responses, half):
    """What the contract compares inside transformations, in one program."""
    first, second = responses
    changed = coupling.with_response(first).with_response(second)
    return {
        "jitted": coupling @ m,
        "mapped": jax.vmap(lambda x: coupling @ x)(skies),
        "slope": jax.grad(lambda x: d @ (coupling @ x))(m),
        "changed": changed.dense(),
        "changed_mv": changed @ m,
        "changed_transpose_mv": changed.transpose_mv(d),
        "slope_of_response": jax.grad(lambda r: d @ (coupling.with_response(r) @ m))(first),
        "plus": coupling.plus(half, coupling).dense(),
        "changed_plus": changed.plus(half, coupling).dense(),
        "plus_dense": changed.plus(half, matrix) @ m,
        "slope_of_plus": jax.grad(lambda x: d @ (coupling.plus(x, coupling) @ m))(half),
    }


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
    assert np.isnan(coupling @ m.at[0].set(jnp.nan)).any()
    skies, responses = rng.standard_normal((3, n_unknowns)), rng.uniform(0.5, 2.0, (2, n_data))
    half, matrix = jnp.asarray(0.5), DenseCoupling(jnp.asarray(dense))
    arguments = (m, d, jnp.asarray(skies), jnp.asarray(responses), half)
    got = _numbers(coupling, matrix, *arguments)
    same(got["jitted"], dense @ sky)
    same(got["mapped"], skies @ dense.T)
    same(got["slope"], dense.T @ data)

    # responses multiply the rows, one on top of the other, and sampling goes through them
    changed = coupling.with_response(arguments[3][0]).with_response(arguments[3][1])
    factors = responses.prod(0)
    rows = factors[:, None] * dense
    assert changed.shape == dense.shape
    same(changed.response, factors)
    same(got["changed"], rows)
    same(got["changed_mv"], rows @ sky)
    same(got["changed_transpose_mv"], rows.T @ data)
    same(got["slope_of_response"], data * (dense @ sky))

    # a multiple of another matrix is added to A itself, the response stays
    same(got["plus"], 1.5 * dense)
    same(got["changed_plus"], 1.5 * rows)
    same(got["plus_dense"], 1.5 * rows @ sky)
    same(got["slope_of_plus"], data @ (dense @ sky))
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
