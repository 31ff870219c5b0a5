"""N: the interface of covariances of the noise, and its kinds.

A :class:`Covariance` describes N by its dense form and its diagonal. :meth:`Covariance.factor` does
the expensive part once and returns a :class:`Factor`, a square root N = L L^T that whitens vectors
(L^-1 x), colours them (L z) and solves with N.

A new structure is one file, such as :mod:`.time_blocks`: implement the abstract methods here, and
``absorb`` for the sums that keep the structure. ``a + b`` tries whether either side can absorb the
other.

**Noise along a few directions**, such as templates with prior variances or beam errors: U U^T is
singular, but added to another covariance N_0 it gives N_0 + U U^T, which is solved through the
small matrix C = 1 + V^T V, V = L_0^-1 U (Woodbury). With C = R R^T, ::

    B = 1 - V R^-T (R + 1)^-1 V^T     satisfies     B B^T = (1 + V V^T)^-1,

so L = L_0 B^-T is a square root of the sum, applied by products with V. Nothing is subtracted
from N_0^-1, which would leave a small difference of large numbers.
"""

from __future__ import annotations

from abc import abstractmethod
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, PRNGKeyArray

from lusee_bayes.core import checks
from lusee_bayes.core.arrays import Array, namespace
from lusee_bayes.core.errors import InputError
from lusee_bayes.core.linalg import checked_cholesky, solve_lower
from lusee_bayes.instrument.products import Columns, DataLayout


class Factor(eqx.Module):
    """A square root L of a covariance: N = L L^T.

    L need not be triangular, and each kind of factor has its own order of whitened entries.
    Only L z of independent normals z, and products of whitened vectors, are meaningful.

    Attributes
    ----------
    couples_times : bool
        Whether N may couple different times. If not, every whitened entry depends only on data of
        its time.
    collinearity : float
        Largest variance of a datum over that which others leave, where blocks would be inverted.
    """

    couples_times, collinearity = True, 1.0

    @abstractmethod
    def whiten(self, x: Columns) -> Columns:
        """Return L^-1 x, for a vector or for every column of a matrix."""

    @abstractmethod
    def whiten_transpose(self, x: Columns) -> Columns:
        """Return L^-T x."""

    @abstractmethod
    def colour(self, z: Columns) -> Columns:
        """Return L z, which turns independent unit normals into samples from N(0, N)."""

    @abstractmethod
    def log_det(self) -> Float[Array, ""]:
        """Return ``ln|N|``."""

    def solve(self, x: Columns) -> Columns:
        """Return N^-1 x."""
        return self.whiten_transpose(self.whiten(x))


class Covariance(checks.Described, eqx.Module):
    """A symmetric positive definite matrix N over the entries of the data vector, in K^2."""

    def description(self) -> tuple[str, ...]:
        return (f"noise covariance of {self.size} data, in K^2",)

    @property
    @abstractmethod
    def size(self) -> int:
        """Number of data."""

    @abstractmethod
    def diagonal(self) -> Float[Array, " data"]:
        """Return the variances."""

    @abstractmethod
    def dense(self) -> Float[Array, "data data"]:
        """Return N as a matrix."""

    @abstractmethod
    def factor(self) -> Factor:
        """Return a square root of N.

        Raises
        ------
        InputError
            If N is not positive definite.
        """

    @abstractmethod
    def absorb(self, other: Covariance) -> Covariance | None:
        """Return ``self + other`` if the structure of ``self`` can represent it, None otherwise."""

    @abstractmethod
    def scaled(self, factor: float | Float[Array, ""]) -> Covariance:
        """Return ``factor * N`` for a positive factor."""

    def time_weights(self, layout: DataLayout) -> Float[Array, "..."] | None:
        """Return N^-1 on the full grid, if N does not couple different times.

        Parameters
        ----------
        layout : DataLayout
            Layout of the data.

        Returns
        -------
        (products, times) or (products, products, times) array, or None
            The inverse variances, or the inverse of the block of every time, zero where a sample is
            missing; None if N has no such structure.

        Raises
        ------
        InputError
            If N is not positive definite.
        """
        return None

    def solve(self, x: Columns) -> Columns:
        """Return N^-1 x."""
        return self.factor().solve(x)

    def log_det(self) -> Float[Array, ""]:
        """Return ``ln|N|``."""
        return self.factor().log_det()

    @property
    def rank(self) -> int:
        """Number of independent normals behind a sample from N(0, N)."""
        return self.size

    def colour(self, z: Float[Array, "white *columns"]) -> Columns:
        """Turn ``rank`` independent normals, or columns of them, into samples from N(0, N)."""
        return self.factor().colour(z)

    def sample(self, key: PRNGKeyArray, n: int | None = None) -> Float[Array, "..."]:
        """Draw from N(0, N): a (data,) array, or an (n, data) one with ``n``."""
        z = jax.random.normal(key, (self.rank, 1 if n is None else n), dtype=jnp.float64)
        if namespace(self) is np and not checks.is_traced(z):
            z = np.asarray(z)
        draws = self.colour(z).T
        return draws[0] if n is None else draws

    def __add__(self, other: Covariance) -> Covariance:
        if self.size != other.size:
            wrong = f"cannot add covariances of {self.size} and {other.size} data; build both alike"
            raise InputError(wrong)
        total = self.absorb(other)
        total = other.absorb(self) if total is None else total
        if total is None:
            raise InputError(
                f"{type(self).__name__} and {type(other).__name__} have no common structure; "
                "convert one of them to DenseCovariance(term.dense())"
            )
        return total


def log_det_of_lower(lower: Float[Array, "*batch n n"]) -> Float[Array, ""]:
    """ln|L L^T|, summed over all blocks."""
    xp = namespace(lower)
    return xp.asarray(2.0 * xp.log(xp.diagonal(lower, axis1=-2, axis2=-1)).sum())


class CholeskyFactor(Factor):
    """The Cholesky factor of a dense covariance.

    Attributes
    ----------
    lower : (data, data) array
        L; only the lower triangle is read.
    """

    lower: Float[Array, "*batch n n"]

    def _columns(self, x: Columns) -> Float[Array, "*batch n all_columns"]:
        return x.reshape(x.shape[0], -1)

    def _data(self, columns: Array, shape: tuple[int, ...]) -> Columns:
        return columns.reshape(shape)

    def whiten(self, x):
        return self._data(solve_lower(self.lower, self._columns(x), transpose=False), x.shape)

    def whiten_transpose(self, x):
        return self._data(solve_lower(self.lower, self._columns(x), transpose=True), x.shape)

    def colour(self, z):
        return self._data(namespace(self).tril(self.lower) @ self._columns(z), z.shape)

    def log_det(self):
        return log_det_of_lower(self.lower)


class DenseCovariance(Covariance):
    """A covariance given as a matrix.

    Attributes
    ----------
    matrix : (data, data) array
        N in K^2.
    name : str
        Name of the term, for error messages.

    Raises
    ------
    InputError
        If the matrix is not square, finite and symmetric.
    """

    matrix: Float[Array, "data data"]
    name: str = eqx.field(static=True, default="the dense covariance")

    def __check_init__(self):
        checks.require_array(self.name, self.matrix, (self.matrix.shape[0],) * 2)
        checks.require_symmetric(self.name, self.matrix)

    @property
    def size(self) -> int:
        return self.matrix.shape[0]

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


def _down(vector: Float[Array, " data"], x: Columns) -> Float[Array, "..."]:
    """The vector shaped to multiply the rows of x."""
    return vector.reshape(-1, *(1,) * (x.ndim - 1))


class DiagonalFactor(Factor):
    """The square root of a diagonal covariance, L = diag(sigma).

    Attributes
    ----------
    sigma : (data,) array
        In K.
    """

    couples_times: ClassVar[bool] = False
    sigma: Float[Array, " data"]

    def whiten(self, x):
        return x / _down(self.sigma, x)

    whiten_transpose = whiten

    def colour(self, z):
        return z * _down(self.sigma, z)

    def log_det(self):
        return 2.0 * namespace(self.sigma).log(self.sigma).sum()


class DiagonalCovariance(Covariance):
    """Independent noise of given variances.

    Attributes
    ----------
    variance : (data,) array
        In K^2.

    Raises
    ------
    InputError
        If a variance is not positive.
    """

    variance: Float[Array, " data"]

    def __check_init__(self):
        checks.require_float64("the noise variance", self.variance)
        checks.require_shape("the noise variance", self.variance, (None,))
        checks.require_positive("the noise variance", self.variance)

    @property
    def size(self) -> int:
        return self.variance.shape[0]

    def diagonal(self):
        return self.variance

    def dense(self):
        return namespace(self.variance).diag(self.variance)

    def factor(self):
        return DiagonalFactor(namespace(self.variance).sqrt(self.variance))

    def time_weights(self, layout):
        return layout.scatter(1.0 / self.variance)

    def absorb(self, other):
        if isinstance(other, DiagonalCovariance):
            return DiagonalCovariance(self.variance + other.variance)
        return None

    def scaled(self, factor):
        return DiagonalCovariance(factor * self.variance)


class LowRankCovariance(Covariance):
    """U U^T, which is only semidefinite: add it to another noise term.

    Attributes
    ----------
    root : (data, rank) array
        U in K.
    name : str
        Name of the term, for error messages.

    Raises
    ------
    InputError
        If U is not a finite matrix.
    """

    root: Float[Array, "data rank"]
    name: str = eqx.field(static=True, default="the low-rank term")

    def __check_init__(self):
        checks.require_array(self.name, self.root, (None, None))

    @property
    def size(self) -> int:
        return self.root.shape[0]

    @property
    def rank(self) -> int:
        return self.root.shape[1]

    def colour(self, z):
        return self.root @ z

    def diagonal(self):
        return (self.root**2).sum(1)

    def dense(self):
        return self.root @ self.root.T

    def factor(self):
        raise InputError(
            f"{self.name} has rank {self.root.shape[1]} at most over {self.size} data, so that it "
            "is not positive definite; add the radiometer noise"
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
        checks.require_positive("the factor of a low-rank term", factor)
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

    def diagonal(self):
        return self.base.diagonal() + self.update.diagonal()

    def dense(self):
        return self.base.dense() + self.update.dense()

    def factor(self, base: Factor | None = None):
        """Return L; the factor of N_0 may be given."""
        base = self.base.factor() if base is None else base
        v = base.whiten(self.update.root)
        small = np.eye(v.shape[1]) + v.T @ v
        return LowRankFactor(base, v, checked_cholesky(f"1 + V^T V of {self.update.name}", small))

    def absorb(self, other):
        if isinstance(other, LowRankUpdate):
            return (self.base + other.base) + (self.update + other.update)
        if isinstance(other, LowRankCovariance):
            return self.base + (self.update + other)
        return (self.base + other) + self.update

    def scaled(self, factor):
        return LowRankUpdate(self.base.scaled(factor), self.update.scaled(factor))


class KnownFactor(Covariance):
    """N with its square root, computed once and not at every evaluation of a program.

    Attributes
    ----------
    covariance : Covariance
        N.
    root : Factor
        Square root of N.
    """

    covariance: Covariance
    root: Factor

    @property
    def size(self) -> int:
        return self.covariance.size

    def diagonal(self):
        return self.covariance.diagonal()

    def dense(self):
        return self.covariance.dense()

    def factor(self):
        return self.root

    def absorb(self, other):
        low_rank = isinstance(other, LowRankCovariance | LowRankUpdate)
        return None if low_rank else self.covariance + other

    def scaled(self, factor):
        return self.covariance.scaled(factor)


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
        roots = self.lower, self.lower + np.eye(self.lower.shape[0])
        first, second = roots if transpose else roots[::-1]
        inner = solve_lower(first, self.v.T @ columns, transpose=False)
        inner = solve_lower(second, inner, transpose=True)
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
        return self.base.log_det() + log_det_of_lower(self.lower)
