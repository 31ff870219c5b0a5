"""Noise along a few directions: templates with prior variances, beam errors.

U U^T alone is singular; added to any other covariance N_0 it gives N_0 + U U^T, which is solved
through the small matrix C = 1 + V^T V, V = L_0^-1 U (Woodbury). With C = R R^T, ::

    B = 1 - V R^-T (R + 1)^-1 V^T     satisfies     B B^T = (1 + V V^T)^-1,

so that L = L_0 B^-T is a square root of the sum, applied by products with V. Nothing is subtracted
from N_0^-1, which would leave a small difference of large numbers.
"""

from __future__ import annotations

import equinox as eqx
import numpy as np
from jaxtyping import Float

from lusee_bayes.core.arrays import Array, namespace
from lusee_bayes.core.checks import require_finite, require_float64, require_positive, require_shape
from lusee_bayes.core.errors import InputError
from lusee_bayes.core.linalg import checked_cholesky, solve_lower
from lusee_bayes.noise.covariance.base import Covariance, Factor
from lusee_bayes.noise.covariance.dense import DenseCovariance


class LowRankCovariance(Covariance):
    """U U^T, which is only semidefinite: add it to another noise term.

    Attributes
    ----------
    root : (data, rank) array
        U in K.
    name : str
        Of the term, for error messages.

    Raises
    ------
    InputError
        If U is not a finite matrix.
    """

    root: Float[Array, "data rank"]
    name: str = eqx.field(static=True, default="the low-rank term")

    def __check_init__(self):
        require_float64(self.name, self.root)
        require_shape(self.name, self.root, (None, None))
        require_finite(self.name, self.root)

    @property
    def size(self) -> int:
        return self.root.shape[0]

    @property
    def rank(self) -> int:
        return self.root.shape[1]

    def colour(self, z):
        return self.root @ z

    def mv(self, x):
        return self.root @ (self.root.T @ x)

    def diagonal(self):
        return (self.root**2).sum(1)

    def dense(self):
        return self.root @ self.root.T

    def factor(self):
        raise InputError(
            f"{self.name} has rank {self.root.shape[1]} at most over {self.size} data, so it is "
            "not positive definite by itself; add the radiometer noise"
        )

    def absorb(self, other):
        if isinstance(other, LowRankCovariance):
            xp = namespace(self, other)
            return LowRankCovariance(xp.concatenate([self.root, other.root], axis=1), self.name)
        if isinstance(other, LowRankUpdate):
            return None
        if self.root.shape[1] >= self.size:  # no structure left: a dense sum is cheaper
            return DenseCovariance(other.dense() + self.dense(), f"the sum with {self.name}")
        return LowRankUpdate(other, self)

    def scaled(self, factor):
        require_positive("the factor of a low-rank term", factor)
        return LowRankCovariance(namespace(self, factor).sqrt(factor) * self.root, self.name)


class LowRankUpdate(Covariance):
    """N_0 + U U^T.

    Attributes
    ----------
    base : Covariance
        N_0, positive definite.
    update : LowRankCovariance
        U U^T.
    """

    base: Covariance
    update: LowRankCovariance

    @property
    def size(self) -> int:
        return self.base.size

    def mv(self, x):
        return self.base.mv(x) + self.update.mv(x)

    def diagonal(self):
        return self.base.diagonal() + self.update.diagonal()

    def dense(self):
        return self.base.dense() + self.update.dense()

    def factor(self):
        base = self.base.factor()
        v = base.whiten(self.update.root)
        small = np.eye(v.shape[1]) + v.T @ v
        lower = checked_cholesky(f"1 + V^T V of {self.update.name}", small)
        return LowRankFactor(base, v, lower)

    def absorb(self, other):
        if isinstance(other, LowRankUpdate):
            return (self.base + other.base) + (self.update + other.update)
        if isinstance(other, LowRankCovariance):
            return self.base + (self.update + other)
        return (self.base + other) + self.update

    def scaled(self, factor):
        return LowRankUpdate(self.base.scaled(factor), self.update.scaled(factor))


class LowRankFactor(Factor):
    """The square root L = L_0 B^-T of N_0 + U U^T.

    Attributes
    ----------
    base : Factor
        L_0.
    v : (data, rank) array
        V = L_0^-1 U.
    lower : (rank, rank) array
        R, the Cholesky factor of 1 + V^T V.
    """

    base: Factor
    v: Float[Array, "data rank"]
    lower: Float[Array, "rank rank"]

    def _shrink(self, x: Array, *, transpose: bool) -> Array:
        """B x, or B^T x with ``transpose``."""
        columns = x.reshape(x.shape[0], -1)
        inner = self.v.T @ columns
        plus_one = self.lower + np.eye(self.lower.shape[0])
        if transpose:
            inner = solve_lower(self.lower, inner, transpose=False)
            inner = solve_lower(plus_one, inner, transpose=True)
        else:
            inner = solve_lower(plus_one, inner, transpose=False)
            inner = solve_lower(self.lower, inner, transpose=True)
        return (columns - self.v @ inner).reshape(x.shape)

    def whiten(self, x):
        return self._shrink(self.base.whiten(x), transpose=True)

    def whiten_transpose(self, x):
        return self.base.whiten_transpose(self._shrink(x, transpose=False))

    def colour(self, z):
        """Return L z = L_0 (1 + V V^T) B z, since B^-T = (1 + V V^T) B."""
        shrunk = self._shrink(z, transpose=False)
        return self.base.colour(shrunk + self.v @ (self.v.T @ shrunk))

    def log_det(self):
        xp = namespace(self)
        return self.base.log_det() + 2.0 * xp.log(xp.diagonal(self.lower)).sum()
