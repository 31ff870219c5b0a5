"""A Gaussian sky whose coefficients are correlated: S = G G^T as a matrix."""

from __future__ import annotations

import equinox as eqx
import numpy as np
from jaxtyping import Float

from lusee_bayes.core.arrays import Array, namespace
from lusee_bayes.core.checks import (
    extent,
    is_traced,
    require_finite,
    require_float64,
    require_shape,
)
from lusee_bayes.core.errors import InputError
from lusee_bayes.core.linalg import cholesky, outer_sandwich, sandwich, solve_lower, times_lower
from lusee_bayes.sky.priors.base import Prior

# largest difference of S_ij and S_ji, in prior standard deviations of both
ASYMMETRY = 1e-10


class DensePrior(Prior):
    """S = G G^T over correlated modes, with G lower triangular, about a mean sky.

    Attributes
    ----------
    root : (modes, modes) array
        G, lower triangular with a positive diagonal, in K.
    mean : (modes,) array or None
        The prior mean, in K, Galactic, real packed; None for zero.

    Raises
    ------
    InputError
        If they are not float64 or not finite, have other shapes, or G is not lower triangular or
        has a diagonal that is not positive.
    """

    root: Float[Array, "modes white"]
    mean: Float[Array, " unknowns"] | None = eqx.field(default=None, kw_only=True)

    def __check_init__(self):
        require_float64("the root of the prior", self.root)
        require_shape("the root of the prior", self.root, (self.size, self.size))
        require_finite("the root of the prior", self.root)
        if self.mean is not None:
            require_float64("the prior mean", self.mean)
            require_shape("the prior mean", self.mean, (self.size,))
            require_finite("the prior mean", self.mean)
        if is_traced(self.root):
            return
        root = np.asarray(self.root)
        above = any(row[k + 1 :].any() for k, row in enumerate(root))
        if above or not (np.diagonal(root) > 0).all():
            raise InputError(
                "the root of the prior must be lower triangular with a positive diagonal; use "
                "DensePrior.of_covariance(S)"
            )

    @classmethod
    def of_covariance(
        cls,
        covariance: Float[Array, "modes columns"],
        mean: Float[Array, " unknowns"] | None = None,
    ) -> DensePrior:
        """Make the prior of a covariance.

        Parameters
        ----------
        covariance : (modes, modes) array
            S, in K^2.
        mean : (modes,) array, optional
            In K.

        Returns
        -------
        DensePrior

        Raises
        ------
        InputError
            If S is not float64, not finite, not symmetric or not positive definite.
        """
        require_float64("the prior covariance", covariance)
        require_finite("the prior covariance", covariance)
        require_shape("the prior covariance", covariance, (len(covariance), len(covariance)))
        lower = cholesky(covariance)
        if not is_traced(lower):
            _require_covariance(np.asarray(covariance), np.asarray(lower))
        return cls(lower, mean=mean)

    def description(self) -> tuple[str, ...]:
        about = "zero" if self.mean is None else "a mean sky"
        width = extent(namespace(self).sqrt(self.variance()), "K")
        return (
            f"correlated coefficients about {about}, {self.size} modes, Galactic",
            f"standard deviations {width}",
        )

    @property
    def size(self) -> int:
        return self.root.shape[0]

    @property
    def rank(self) -> int:
        return self.size

    @property
    def invertible(self) -> bool:
        return True

    @property
    def independent(self) -> bool:
        return False

    @property
    def white_mean(self) -> Float[Array, " white"] | None:
        return None if self.mean is None else self.whiten(self.mean)

    def colour(self, u):
        return times_lower(u.reshape(-1, self.size), self.root, transpose=True).reshape(u.shape)

    def colour_columns(self, a):
        return times_lower(a, self.root, transpose=False)

    def whiten(self, m):
        flat = m.reshape(-1, self.size)
        return solve_lower(self.root, flat.T, transpose=False).T.reshape(m.shape)

    def whiten_columns(self, a):
        return solve_lower(self.root, a.T, transpose=True).T

    def sandwich(self, matrix):
        return sandwich(matrix, self.root)

    def colour_covariance(self, white):
        return outer_sandwich(white, self.root)

    def widened(self, factor):
        return DensePrior(self.root * factor, mean=self.mean)

    def variance(self):
        xp = namespace(self)
        return xp.einsum("ij,ij->i", self.root, self.root)

    def covariance(self):
        product = times_lower(self.root, self.root, transpose=True)
        return (product + product.T) / 2.0

    def log_det(self):
        xp = namespace(self)
        return xp.asarray(xp.log(xp.diagonal(self.root)).sum())

    def require_density(self) -> None:
        """G has an inverse."""


def _require_covariance(
    covariance: Float[np.ndarray, "modes modes"], lower: Float[np.ndarray, "modes modes"]
) -> None:
    width = np.sqrt(np.abs(np.diagonal(covariance)))
    uneven = np.abs(covariance - covariance.T)
    if (uneven > ASYMMETRY * width[:, None] * width[None]).any():
        i, j = np.unravel_index(int(np.argmax(uneven)), uneven.shape)
        raise InputError(
            f"the prior covariance is not symmetric: S[{i}, {j}] = {covariance[i, j]:.6g}, "
            f"S[{j}, {i}] = {covariance[j, i]:.6g} K^2; give (S + S^T) / 2"
        )
    if not np.isfinite(lower).all():
        lowest = np.linalg.eigvalsh(covariance)[0]
        raise InputError(
            f"the prior covariance is not positive definite: its lowest eigenvalue is "
            f"{lowest:.3g} K^2 (largest variance {width.max() ** 2:.3g} K^2); give every mode a "
            "variance of its own"
        )
