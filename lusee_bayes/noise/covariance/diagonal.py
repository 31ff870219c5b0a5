"""Independent noise: N = diag(variance)."""

from __future__ import annotations

from typing import ClassVar

from jaxtyping import Float

from lusee_bayes.core.arrays import Array, namespace
from lusee_bayes.core.checks import require_float64, require_positive, require_shape
from lusee_bayes.noise.covariance.base import Covariance, Factor


def _down(vector: Float[Array, " data"], x: Float[Array, "data *columns"]) -> Float[Array, "..."]:
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

    def whiten_transpose(self, x):
        return x / _down(self.sigma, x)

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
        require_float64("the noise variance", self.variance)
        require_shape("the noise variance", self.variance, (None,))
        require_positive("the noise variance", self.variance)

    @property
    def size(self) -> int:
        return self.variance.shape[0]

    def mv(self, x):
        return x * _down(self.variance, x)

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
