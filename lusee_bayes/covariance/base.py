"""The protocol that every covariance obeys.

A :class:`Covariance` says what N is: its product with a vector, its dense form, its diagonal.
:meth:`Covariance.factor` does the expensive part once and gives a :class:`Factor`, a square root
N = L L^T with which vectors are whitened (L^-1 x), coloured (L z) and solved for.

A new structure is one file: implement the abstract methods here, and ``absorb`` for the sums that
keep the structure. ``a + b`` asks each side whether it can take up the other, and falls back to
the dense sum.
"""

from __future__ import annotations

from abc import abstractmethod

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from lusee_bayes.checks import InputError, is_traced


class Factor(eqx.Module):
    """A square root L of a covariance: N = L L^T.

    L need not be triangular, and the order of whitened entries is the factor's own: only L z of
    independent normals z, and products of whitened vectors with each other, mean anything.
    """

    @abstractmethod
    def whiten(self, x: Float[Array, "data *columns"]) -> Float[Array, "data *columns"]:
        """L^-1 x, for a vector or for every column of a matrix."""

    @abstractmethod
    def whiten_transpose(self, x: Float[Array, "data *columns"]) -> Float[Array, "data *columns"]:
        """L^-T x."""

    @abstractmethod
    def colour(self, z: Float[Array, "data *columns"]) -> Float[Array, "data *columns"]:
        """L z: turns independent unit normals into draws of N(0, N)."""

    @abstractmethod
    def log_det(self) -> Float[Array, ""]:
        """ln |N|."""

    def solve(self, x: Float[Array, "data *columns"]) -> Float[Array, "data *columns"]:
        """N^-1 x."""
        return self.whiten_transpose(self.whiten(x))


class Covariance(eqx.Module):
    """A symmetric positive definite matrix N over the entries of the data vector, in K^2."""

    @property
    @abstractmethod
    def size(self) -> int:
        """Number of data."""

    @abstractmethod
    def mv(self, x: Float[Array, "data *columns"]) -> Float[Array, "data *columns"]:
        """N x, for a vector or for every column of a matrix."""

    @abstractmethod
    def diagonal(self) -> Float[Array, " data"]:
        """The variances."""

    @abstractmethod
    def dense(self) -> Float[Array, "data data"]:
        """N as a matrix."""

    @abstractmethod
    def factor(self) -> Factor:
        """The square root; InputError if N is not positive definite."""

    @abstractmethod
    def absorb(self, other: Covariance) -> Covariance | None:
        """``self + other`` if that keeps the structure of ``self``, else None."""

    @abstractmethod
    def scaled(self, factor: float | Float[Array, ""]) -> Covariance:
        """``factor * N``; the factor must be positive (checked when it is factorised)."""

    def solve(self, x: Float[Array, "data *columns"]) -> Float[Array, "data *columns"]:
        """N^-1 x."""
        return self.factor().solve(x)

    def log_det(self) -> Float[Array, ""]:
        """ln |N|."""
        return self.factor().log_det()

    def sample(self, key: PRNGKeyArray, n: int | None = None) -> Float[Array, "..."]:
        """A draw of N(0, N), shape (data,); with ``n``, that many draws, shape (n, data)."""
        z = jax.random.normal(key, (self.size, 1 if n is None else n), dtype=jnp.float64)
        draws = self.factor().colour(z).T
        return draws[0] if n is None else draws

    def __add__(self, other: Covariance) -> Covariance:
        if self.size != other.size:
            raise InputError(
                f"cannot add covariances of {self.size} and {other.size} data; "
                "build both terms for the same observation and flags"
            )
        total = self.absorb(other)
        if total is None:
            total = other.absorb(self)
        if total is None:
            raise InputError(
                f"{type(self).__name__} and {type(other).__name__} have no common structure; "
                "turn one of them into DenseCovariance(term.dense())"
            )
        return total


def checked_cholesky(name: str, matrix: Float[Array, "*batch n n"]) -> Float[Array, "*batch n n"]:
    """Lower Cholesky factor(s); InputError naming the term and its lowest eigenvalue if none."""
    lower = jax.lax.linalg.cholesky(matrix, symmetrize_input=False)
    if not is_traced(lower) and not bool(jnp.isfinite(lower).all()):
        lowest = float(jnp.linalg.eigvalsh(matrix).min())
        largest = float(jnp.abs(matrix).max())
        raise InputError(
            f"{name} is not positive definite: its lowest eigenvalue is {lowest:.3g} "
            f"(largest entry {largest:.3g}); check the term's amplitude and symmetry"
        )
    return lower


def solve_lower(
    lower: Float[Array, "*batch n n"], x: Float[Array, "*batch n columns"], *, transpose: bool
) -> Float[Array, "*batch n columns"]:
    """L^-1 x, or L^-T x with ``transpose``, for lower triangular L."""
    return jax.lax.linalg.triangular_solve(
        lower, x, left_side=True, lower=True, transpose_a=transpose
    )
