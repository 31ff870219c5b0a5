"""Noise without any structure: N is a full matrix."""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Float

from lusee_bayes.core.arrays import Array
from lusee_bayes.core.checks import (
    require_finite,
    require_float64,
    require_shape,
    require_symmetric,
)
from lusee_bayes.core.linalg import checked_cholesky, solve_lower
from lusee_bayes.noise.covariance.base import Covariance, Factor


def _as_columns(x: Float[Array, "data *columns"]) -> Float[Array, "data all_columns"]:
    return x.reshape(x.shape[0], -1)


class CholeskyFactor(Factor):
    """The Cholesky factor of a dense covariance.

    Attributes
    ----------
    lower : (data, data) array
        L; only the lower triangle is read.
    """

    lower: Float[Array, "data data"]

    def whiten(self, x):
        return solve_lower(self.lower, _as_columns(x), transpose=False).reshape(x.shape)

    def whiten_transpose(self, x):
        return solve_lower(self.lower, _as_columns(x), transpose=True).reshape(x.shape)

    def colour(self, z):
        return jnp.tril(self.lower) @ z

    def log_det(self):
        return 2.0 * jnp.log(jnp.diagonal(self.lower)).sum()


class DenseCovariance(Covariance):
    """A covariance that is given as a matrix.

    Attributes
    ----------
    matrix : (data, data) array
        N in K^2.
    name : str
        Of the term, for error messages.

    Raises
    ------
    InputError
        Unless the matrix is square, finite and symmetric.
    """

    matrix: Float[Array, "data data"]
    name: str = eqx.field(static=True, default="the dense covariance")

    def __check_init__(self):
        require_float64(self.name, self.matrix)
        require_shape(self.name, self.matrix, (self.matrix.shape[0],) * 2)
        require_finite(self.name, self.matrix)
        require_symmetric(self.name, self.matrix)

    @property
    def size(self) -> int:
        return self.matrix.shape[0]

    def mv(self, x):
        return self.matrix @ x

    def diagonal(self):
        return jnp.diagonal(self.matrix)

    def dense(self):
        return self.matrix

    def factor(self):
        return CholeskyFactor(checked_cholesky(self.name, self.matrix))

    def absorb(self, other):
        return DenseCovariance(self.matrix + other.dense(), self.name)

    def scaled(self, factor):
        return DenseCovariance(factor * self.matrix, self.name)
