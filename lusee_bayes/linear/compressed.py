"""Data compressed to a few numbers that contain all information about the sky.

A^T N^-1 (d - A mean) is sufficient for any sky, and many of its combinations have no information.
A pivoted Cholesky factorisation of A^T N^-1 A finds the r of them that do, ::

    q = V^T (m - mean) + n,    n ~ N(0, 1),    V V^T = A^T N^-1 A,

so that under a prior N(mean, S) they have the covariance 1 + V^T S V, and ::

    ln p(d) = constant - 1/2 ln|1 + V^T S V| - 1/2 q^T (1 + V^T S V)^-1 q.

For the fiducial scenario at lmax 47, r is 1,289 of 2,304, and a step of learning S takes two thirds
of the time.
"""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, PRNGKeyArray

from lusee_bayes.core.arrays import Draws, Modes, Square
from lusee_bayes.core.linalg import checked_cholesky, pivoted_cholesky, solve_lower
from lusee_bayes.linear.information import Information
from lusee_bayes.sky.prior import Prior

# information about a mode, relative to its expected prior variance, that may be left out
LEAST = 1e-9

# arrays that recur
Combinations = Float[np.ndarray, " combinations"]


@dataclass(frozen=True)
class Compressed:
    """Combinations q of data, for priors with one mean.

    Attributes
    ----------
    mean : (modes,) array
        Of the priors, in K.
    response : (combinations, modes) array
        V^T, in 1/K.
    data : (combinations,) array
        q.
    constant : float
        ln p(d) without the terms that depend on S.
    """

    mean: Modes
    response: Float[np.ndarray, "combinations modes"]
    data: Combinations
    constant: float

    @classmethod
    def of(cls, information: Information, mean: Modes | None, variance: Modes) -> Compressed:
        """Compress the information in data.

        Parameters
        ----------
        information : Information
        mean : (modes,) array or None
            Of the priors, in K; None for zero.
        variance : (modes,) array
            Of a typical prior, in K^2: what has less than ``LEAST`` of information about a mode
            in its units is left out.
        """
        mean = np.zeros(len(variance)) if mean is None else np.asarray(mean)
        std = np.sqrt(variance)
        lower, order = pivoted_cholesky(information.matrix * std * std[:, None], LEAST)
        first = order[: lower.shape[1]]
        # about the reference sky, where the terms of chi^2 are of the order of the number of data
        data = solve_lower(lower[first], (std * information.vector)[first, None], transpose=False)
        response, data = np.ascontiguousarray((lower / std[:, None]).T), data[:, 0]
        rest = information.misfit - data @ data + information.log_det
        constant = -0.5 * (rest + information.n_data * np.log(2.0 * np.pi))
        data = data + response @ (information.reference - mean)
        return cls(mean, response, data, float(constant))

    def covariance(self, prior: Prior) -> Square:
        """Compute that of q, 1 + V^T S V."""
        seen = prior.colour_columns(self.response)
        covariance = seen @ seen.T
        covariance[np.diag_indices_from(covariance)] += 1.0
        return covariance

    def root(self, covariance: Square) -> Square:
        """Compute the Cholesky factor of such a covariance."""
        return checked_cholesky("the covariance of the data", covariance)

    def log_evidence(self, lower: Square) -> float:
        """Compute ln p(d), for data in K, given :meth:`root`."""
        white = solve_lower(lower, self.data[:, None], transpose=False)
        log_det = np.log(np.diagonal(lower)).sum()
        return float(self.constant - log_det - 0.5 * np.vdot(white, white))

    def sample(self, prior: Prior, key: PRNGKeyArray, n: int) -> Draws:
        """Draw skies from the posterior.

        Parameters
        ----------
        prior : Prior
            With the mean.
        key : PRNG key
        n : int

        Returns
        -------
        (n, modes) array
            In K.
        """
        lower = self.root(self.covariance(prior))
        shape = n, sum(self.response.shape)
        drawn = np.asarray(jax.random.normal(key, shape, dtype=jnp.float64))
        noise, u = np.split(drawn, [len(lower)], axis=1)
        # a sky and data from the prior; the difference from the data corrects the sky
        skies = prior.colour(u)
        missed = self.data - skies @ self.response.T - noise
        half = solve_lower(lower, missed.T, transpose=False)
        pulled = solve_lower(lower, half, transpose=True).T @ self.response
        return self.mean + skies + prior.colour(prior.colour_columns(pulled))
