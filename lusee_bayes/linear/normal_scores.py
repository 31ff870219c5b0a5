"""A family's parameters in coordinates in which what is expected of them is standard normal.

Parameters that the data do not tell keep what is expected of them, which has heavy tails: Laplace's
approximation misses 0.32 in ln p(d) for every such theta, and 0.11 for every cell. In normal scores
z, theta_i = F_i^-1(Phi(z_i)) with F_i the hyperprior's distribution function, it is exact for them.
ln p(d | theta) being quadratic about the most probable theta*, with slope g and curvature F, ::

    ln p(d, z) = const + g.(theta - theta*) - 1/2 (theta - theta*)^T F (theta - theta*) - 1/2 |z|^2

is raised by Newton's method, J = d theta / d z, with the precision P = J F J + 1. Two steps get
there; the quadratic form holds near theta* only, and further ones may leave for a maximum of its
own.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from lusee_bayes.core.linalg import checked_cholesky, invert_lower
from lusee_bayes.sky.prior_family import Hyperprior

# steps of Newton's method, each halved until ln p is not lower
STEPS, HALVINGS = 2, 10


@dataclass(frozen=True)
class NormalScores:
    """A normal distribution of normal scores, about their maximum.

    Attributes
    ----------
    hyperprior : Hyperprior
    mean : (parameters,) array
    root : (parameters, parameters) array
        R with the covariance R R^T.
    """

    hyperprior: Hyperprior
    mean: Float[np.ndarray, " parameters"]
    root: Float[np.ndarray, "parameters parameters"]

    @classmethod
    def around(
        cls,
        hyperprior: Hyperprior,
        parameters: Float[np.ndarray, " parameters"],
        covariance: Float[np.ndarray, "parameters parameters"],
    ) -> NormalScores:
        """Transform the normal distribution about the most probable parameters.

        Parameters
        ----------
        hyperprior : Hyperprior
        parameters : (parameters,) array
            Most probable, hyperprior included.
        covariance : (parameters, parameters) array
            Of the normal distribution about them.

        Raises
        ------
        InputError
            If the data's curvature is far from positive.
        """
        known = np.linalg.inv(covariance) - np.diag(hyperprior.curvature(parameters))
        slope = -hyperprior.gradient(parameters)

        def value(z: Float[np.ndarray, " parameters"]) -> float:
            off = hyperprior.of_scores(z) - parameters
            return float(slope @ off - 0.5 * off @ known @ off - 0.5 * z @ z)

        def precision(z: Float[np.ndarray, " parameters"]) -> np.ndarray:
            j = hyperprior.slopes_of_scores(z)
            return j[:, None] * known * j + np.eye(len(z))

        z = hyperprior.scores(parameters)
        for _ in range(STEPS):
            pull = slope - known @ (hyperprior.of_scores(z) - parameters)
            gradient = hyperprior.slopes_of_scores(z) * pull - z
            step = np.linalg.solve(precision(z), gradient)
            tried = (z + 0.5**k * step for k in range(HALVINGS))
            z = next((there for there in tried if value(there) >= value(z)), z)
        root = invert_lower(checked_cholesky("the curvature of the parameters", precision(z))).T
        return cls(hyperprior, z, root)

    def log_evidence(self, log_likelihood: float) -> float:
        """Compute ln p(d) by Laplace's approximation, of ln p(d | theta) at the mean."""
        volume = float(np.log(np.diagonal(self.root)).sum())
        return log_likelihood + volume - 0.5 * float(self.mean @ self.mean)
