"""The protocol of priors on the sky, m ~ N(mu, S) through a square root S = G G^T.

Everything downstream works with the whitened sky u = G^-1 m ~ N(G^-1 mu, 1). S itself is never
inverted, so a mode without variance is one that is known to be zero, not an error.
"""

from __future__ import annotations

from abc import abstractmethod

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Float, PRNGKeyArray

from lusee_bayes.core.arrays import Array
from lusee_bayes.core.checks import Described


class Prior(Described, eqx.Module):
    """N(mu, S) over the sky's unknowns, as m = G u of independent normals u of unit variance."""

    def description(self) -> tuple[str, ...]:
        return (f"{self.size} unknowns of {self.rank} independent normals",)

    @property
    @abstractmethod
    def size(self) -> int:
        """Number of unknowns in m."""

    @property
    @abstractmethod
    def rank(self) -> int:
        """Number of independent normals behind them."""

    @property
    @abstractmethod
    def invertible(self) -> bool:
        """Whether m tells u, but for unknowns without variance: :meth:`whiten` needs it."""

    @property
    @abstractmethod
    def independent(self) -> bool:
        """Whether S is diagonal; it may save work."""

    @abstractmethod
    def colour(self, u: Float[Array, "*batch white"]) -> Float[Array, "*batch unknowns"]:
        """Compute G u, on the last axis."""

    @abstractmethod
    def colour_columns(self, a: Float[Array, "rows unknowns"]) -> Float[Array, "rows white"]:
        """Compute A G: the columns of A in units of the prior."""

    @abstractmethod
    def whiten(self, m: Float[Array, "*batch unknowns"]) -> Float[Array, "*batch white"]:
        """Compute G^-1 m, on the last axis; zero for unknowns without variance.

        Raises
        ------
        InputError
            If G has no inverse (:attr:`invertible`).
        """

    @abstractmethod
    def whiten_columns(self, a: Float[Array, "rows white"]) -> Float[Array, "rows unknowns"]:
        """Compute A G^-1, the inverse of :meth:`colour_columns`; as :meth:`whiten`."""

    @abstractmethod
    def sandwich(self, matrix: Float[Array, "unknowns unknowns"]) -> Float[Array, "white white"]:
        """Compute G^T M G of a symmetric M, which may be an information about m: that about u."""

    def colour_covariance(
        self, white: Float[Array, "white white"]
    ) -> Float[Array, "unknowns unknowns"]:
        """Compute G C G^T of a symmetric C, such as the covariance of u: that of m.

        NumPy's C may be overwritten.
        """
        return self.colour(self.colour(white).T)

    @abstractmethod
    def variance(self) -> Float[Array, " unknowns"]:
        """Return the diagonal of S, in K^2."""

    @abstractmethod
    def covariance(self) -> Float[Array, "unknowns unknowns"]:
        """Return S as a matrix, in K^2."""

    @abstractmethod
    def widened(self, factor: float) -> Prior:
        """Return the prior about the same mean whose standard deviations are multiplied."""

    @abstractmethod
    def log_det(self) -> Float[Array, ""]:
        """Compute ``ln|det G|``, for G in K.

        Raises
        ------
        InputError
            As :meth:`require_density`.
        """

    @abstractmethod
    def require_density(self) -> None:
        """Raise an InputError if S is singular, so that m has no density."""

    @property
    def white_mean(self) -> Float[Array, " white"] | None:
        """Mean of u; None for zero."""
        return None

    def sample(self, key: PRNGKeyArray, n: int | None = None) -> Float[Array, "..."]:
        """Draw skies from the prior.

        Parameters
        ----------
        key : PRNG key
            For the draw.
        n : int, optional
            How many; by default one.

        Returns
        -------
        (unknowns,) or (n, unknowns) array
            In K.
        """
        shape = (self.rank,) if n is None else (n, self.rank)
        u = jax.random.normal(key, shape, dtype=jnp.float64)
        if self.white_mean is not None:
            u = u + self.white_mean.reshape(*(1,) * (u.ndim - 1), -1)
        return self.colour(u)
