"""The protocol of all covariances.

A :class:`Covariance` describes N by its product with a vector, its dense form and its diagonal.
:meth:`Covariance.factor` does the expensive part once and returns a :class:`Factor`, a square root
N = L L^T that whitens vectors (L^-1 x), colours them (L z) and solves with N.

A new structure is one file: implement the abstract methods here, and ``absorb`` for the sums that
keep the structure. ``a + b`` tries whether either side can absorb the other.
"""

from __future__ import annotations

from abc import abstractmethod
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, PRNGKeyArray

from lusee_bayes.core.arrays import Array, namespace
from lusee_bayes.core.checks import Described, is_traced
from lusee_bayes.core.errors import InputError
from lusee_bayes.instrument.layout import DataLayout


class Factor(eqx.Module):
    """A square root L of a covariance: N = L L^T.

    L need not be triangular, and each kind of factor orders whitened entries as it likes: only L z
    of independent normals z, and products of whitened vectors with each other, have a meaning.

    Attributes
    ----------
    couples_times : bool
        Whether N may couple different times. If not, every whitened entry is made of data of its
        own time.
    """

    couples_times: ClassVar[bool] = True

    @abstractmethod
    def whiten(self, x: Float[Array, "data *columns"]) -> Float[Array, "data *columns"]:
        """Return L^-1 x, for a vector or for every column of a matrix."""

    @abstractmethod
    def whiten_transpose(self, x: Float[Array, "data *columns"]) -> Float[Array, "data *columns"]:
        """Return L^-T x."""

    @abstractmethod
    def colour(self, z: Float[Array, "data *columns"]) -> Float[Array, "data *columns"]:
        """Return L z, which turns independent unit normals into draws of N(0, N)."""

    @abstractmethod
    def log_det(self) -> Float[Array, ""]:
        """Return ``ln|N|``."""

    def solve(self, x: Float[Array, "data *columns"]) -> Float[Array, "data *columns"]:
        """Return N^-1 x."""
        return self.whiten_transpose(self.whiten(x))


class Covariance(Described, eqx.Module):
    """A symmetric positive definite matrix N over the entries of the data vector, in K^2."""

    def description(self) -> tuple[str, ...]:
        return (f"noise covariance of {self.size} data, in K^2",)

    @property
    @abstractmethod
    def size(self) -> int:
        """Number of data."""

    @abstractmethod
    def mv(self, x: Float[Array, "data *columns"]) -> Float[Array, "data *columns"]:
        """Return N x, for a vector or for every column of a matrix."""

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
        """Return ``self + other`` if ``self`` has a structure that can hold it, None otherwise."""

    @abstractmethod
    def scaled(self, factor: float | Float[Array, ""]) -> Covariance:
        """Return ``factor * N`` for a positive factor."""

    def time_weights(self, layout: DataLayout) -> Float[Array, "..."] | None:
        """Return N^-1 on the full grid, if N couples no two times.

        Parameters
        ----------
        layout : DataLayout
            Of the data.

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

    def solve(self, x: Float[Array, "data *columns"]) -> Float[Array, "data *columns"]:
        """Return N^-1 x."""
        return self.factor().solve(x)

    def log_det(self) -> Float[Array, ""]:
        """Return ``ln|N|``."""
        return self.factor().log_det()

    @property
    def rank(self) -> int:
        """Number of independent normals behind a draw of N(0, N)."""
        return self.size

    def colour(self, z: Float[Array, "white *columns"]) -> Float[Array, "data *columns"]:
        """Turn ``rank`` independent normals, or columns of them, into draws of N(0, N)."""
        return self.factor().colour(z)

    def sample(self, key: PRNGKeyArray, n: int | None = None) -> Float[Array, "..."]:
        """Draw from N(0, N): a (data,) array, or an (n, data) one with ``n``."""
        z = jax.random.normal(key, (self.rank, 1 if n is None else n), dtype=jnp.float64)
        if namespace(self) is np and not is_traced(z):
            z = np.asarray(z)
        draws = self.colour(z).T
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
