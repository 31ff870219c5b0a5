"""Priors of independent unknowns: S = diag(root^2)."""

from __future__ import annotations

from abc import abstractmethod

import numpy as np
from jaxtyping import Float

from lusee_bayes.core.arrays import Array, namespace
from lusee_bayes.core.checks import is_traced, require_finite, require_float64
from lusee_bayes.core.errors import InputError
from lusee_bayes.core.linalg import scaled
from lusee_bayes.sky.priors.base import Prior


class DiagonalPrior(Prior):
    """A prior whose G is diagonal."""

    @property
    @abstractmethod
    def widths(self) -> Float[Array, " unknowns"]:
        """The diagonal of G: prior standard deviations, each in its unknown's unit."""

    @property
    def size(self) -> int:
        return self.widths.shape[0]

    @property
    def rank(self) -> int:
        return self.size

    @property
    def invertible(self) -> bool:
        return True

    @property
    def independent(self) -> bool:
        return True

    def colour(self, u):
        return u * self.widths.reshape(*(1,) * (u.ndim - 1), -1)

    def colour_columns(self, a):
        return self.colour(a)

    def whiten(self, m):
        xp, root = namespace(m, self), self.widths.reshape(*(1,) * (m.ndim - 1), -1)
        power = root != 0
        return xp.where(power, m / xp.where(power, root, 1.0), 0.0)

    def whiten_columns(self, a):
        return self.whiten(a)

    def sandwich(self, matrix):
        return scaled(matrix, self.widths)

    def colour_covariance(self, white):
        return scaled(white, self.widths, overwrite=True)

    def variance(self):
        return self.widths**2

    def covariance(self):
        return namespace(self).diag(self.variance())

    def log_det(self):
        self.require_density()
        xp = namespace(self)
        return xp.asarray(xp.log(xp.abs(self.widths)).sum())

    def require_density(self) -> None:
        if not is_traced(self.widths) and not np.asarray(self.widths).all():
            zero = int(np.argmin(np.abs(np.asarray(self.widths))))
            raise InputError(f"unknown {zero} has no prior variance and no density; drop it")


class IndependentPrior(DiagonalPrior):
    """Independent unknowns of any kind, such as sky modes and source fluxes: S = diag(root^2).

    Attributes
    ----------
    root : (unknowns,) array
        Prior standard deviations, each in its unknown's unit.

    Raises
    ------
    InputError
        If they are not float64 or not finite.
    """

    root: Float[Array, " unknowns"]

    def __check_init__(self):
        require_float64("the prior's standard deviations", self.root)
        require_finite("the prior's standard deviations", self.root)

    @property
    def widths(self) -> Float[Array, " unknowns"]:
        return self.root

    def widened(self, factor):
        return IndependentPrior(self.root * factor)
