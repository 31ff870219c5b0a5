"""A coupling matrix that is given as an array of numbers."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Float

from lusee_bayes.core.arrays import Array
from lusee_bayes.core.checks import require_finite, require_float64, require_shape
from lusee_bayes.core.errors import InputError
from lusee_bayes.instrument.coupling.base import Coupling


class DenseCoupling(Coupling):
    """A as an array.

    Parameters
    ----------
    matrix : (data, unknowns) array
        A without the response. The unknowns need not be harmonic coefficients.
    response : (data,) array or None
        Factors of the rows, such as gains; None for ones.

    Raises
    ------
    InputError
        If ``matrix`` is not a float64 matrix, or holds NaN or infinity. Values are not checked
        inside a JAX transformation.
    """

    matrix: Float[Array, "data unknowns"]

    def __init__(
        self,
        matrix: Float[Array, "data unknowns"],
        *,
        response: Float[Array, " data"] | None = None,
    ):
        require_float64("the coupling matrix", matrix)
        require_shape("the coupling matrix", matrix, (None, None))
        require_finite("the coupling matrix", matrix)
        self.matrix = jnp.asarray(matrix)
        self.response = response

    @property
    def shape(self) -> tuple[int, int]:
        return self.matrix.shape

    def dense(self):
        return self.matrix if self.response is None else self.matrix * self.response[:, None]

    def plus(self, amplitude, direction):
        require_shape("the direction", direction, self.shape)
        if direction.response is not None:
            raise InputError("the direction must have no response of its own")
        return DenseCoupling(self.matrix + amplitude * direction.dense(), response=self.response)

    def _forward(self, sky):
        data = self.matrix @ sky
        return data if self.response is None else data * self.response

    def _backward(self, data):
        return self.matrix.T @ (data if self.response is None else data * self.response)


def as_coupling(coupling: Coupling | Array) -> Coupling:
    """Wrap an array in a :class:`DenseCoupling`; a coupling is returned as it is."""
    return coupling if isinstance(coupling, Coupling) else DenseCoupling(coupling)
