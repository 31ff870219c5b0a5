"""The protocol that every coupling matrix A obeys.

A new kind is one file: implement the abstract methods here. ``lusee_bayes.testing.check_coupling``
tells whether it keeps the contract.
"""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import replace

import equinox as eqx
from jaxtyping import Float

from lusee_bayes.core.arrays import Array
from lusee_bayes.core.checks import Described, require_finite, require_float64, require_shape


class Coupling(Described, eqx.Module):
    """A matrix A, of shape (data, unknowns), from a sky in K to data in K.

    Attributes
    ----------
    response : (data,) array or None
        Factors of the rows, such as gains; None for ones.
    """

    response: Float[Array, " data"] | None = eqx.field(default=None, kw_only=True)

    def description(self) -> tuple[str, ...]:
        data, unknowns = self.shape
        return (f"{data} data x {unknowns} unknowns of the sky, K per K",)

    @property
    @abstractmethod
    def shape(self) -> tuple[int, int]:
        """(data, unknowns)"""

    @property
    def has_time_structure(self) -> bool:
        """Whether A^T N^-1 A can be summed over time without A (``linear.normal_matrix``)."""
        return False

    @abstractmethod
    def dense(self) -> Float[Array, "data unknowns"]:
        """A as a matrix."""

    @abstractmethod
    def plus(self, amplitude: Float[Array, ""], direction: Coupling) -> Coupling:
        """Add a multiple of another coupling matrix: R (A + amplitude dA), with the response R.

        Parameters
        ----------
        amplitude : () array
            The factor of dA.
        direction : Coupling
            dA, of the same data and unknowns, without a response of its own.

        Returns
        -------
        Coupling
            The sum, of the same kind as ``self`` if both are of one kind.

        Raises
        ------
        InputError
            If ``direction`` has a response, or is of other data or unknowns.
        """

    @abstractmethod
    def _forward(self, sky: Float[Array, " unknowns"]) -> Float[Array, " data"]:
        """A m, of a vector whose type and shape are right."""

    @abstractmethod
    def _backward(self, data: Float[Array, " data"]) -> Float[Array, " unknowns"]:
        """A^T d, of a vector whose type and shape are right."""

    def __matmul__(self, sky: Float[Array, " unknowns"]) -> Float[Array, " data"]:
        """Compute A m: the mean data of a sky.

        Parameters
        ----------
        sky : (unknowns,) array
            In K; for harmonics the Galactic coefficients. Its values are not checked: NaN gives
            NaN.

        Returns
        -------
        (data,) array
            Visibilities in K.

        Raises
        ------
        InputError
            If ``sky`` is not float64 or has another length.
        """
        require_float64("the sky", sky)
        require_shape("the sky", sky, (self.shape[1],))
        return self._forward(sky)

    def transpose_mv(self, data: Float[Array, " data"]) -> Float[Array, " unknowns"]:
        """Compute A^T d.

        Parameters
        ----------
        data : (data,) array
            Any vector of the length of the data.

        Returns
        -------
        (unknowns,) array
            A^T d, in the unit of ``data``.

        Raises
        ------
        InputError
            If ``data`` is not float64 or has another length.
        """
        require_float64("the data", data)
        require_shape("the data", data, (self.shape[0],))
        return self._backward(data)

    def with_response(self, factors: Float[Array, " data"]) -> Coupling:
        """Multiply every row by a factor, on top of those it has.

        Parameters
        ----------
        factors : (data,) array
            Factors without a unit, such as gains.

        Returns
        -------
        Coupling
            The same kind of matrix, with the new response.

        Raises
        ------
        InputError
            If ``factors`` is not float64, not finite, or of another length.
        """
        require_float64("the response", factors)
        require_shape("the response", factors, (self.shape[0],))
        require_finite("the response", factors)
        factors = factors if self.response is None else self.response * factors
        return replace(self, response=factors)
