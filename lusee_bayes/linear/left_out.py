"""The protocol of what tells how a group of data differs from its prediction by all others.

With K = A S A^T + N the covariance of data under the model and u = K^-1 (d - E[d]), a group s
differs from its prediction by K_ss^-1 u_s, K_ss being a block of K^-1, and ::

    chi^2_s = u_s^T K_ss^-1 u_s,
    ln p(d_s | all others) = 1/2 [ln|K_ss| - chi^2_s - n_s ln 2 pi].

Of noise alone its mean is tr K_ss^-1 (K^-1 N K^-1)_ss. Under a wide prior that is the number of
data, less one for every direction of the sky that only this group measures.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float


class Missed(NamedTuple):
    """How a group differs from its prediction.

    Attributes
    ----------
    chi2 : float
        chi^2_s.
    directions : float
        By how much its mean is below the number of data, if there is noise alone.
    log_det : float
        ln|K_ss|, with K_ss in 1/K^2: large where the others predict the group well.
    """

    chi2: float
    directions: float
    log_det: float

    def log_density(self, n: int) -> float:
        """Compute ln p(d_s | all others) of a group of ``n`` data in K."""
        return 0.5 * (self.log_det - self.chi2 - n * float(np.log(2.0 * np.pi)))


class LeftOut(ABC):
    """A model and its data, ready to leave out groups of them.

    Attributes
    ----------
    u : (products, times) array
        K^-1 (d - E[d]), in 1/K; zero where a sample is missing.
    inverse_diagonal : (products, times) array
        The diagonal of K^-1, in 1/K^2, of the data that :meth:`stretch` has left out; else NaN.
    """

    u: Float[np.ndarray, "products times"]
    inverse_diagonal: Float[np.ndarray, "products times"]

    @abstractmethod
    def stretch(self, times: Bool[np.ndarray, " times"]) -> Missed:
        """Leave out all data of a stretch of time, such as a day."""

    @abstractmethod
    def together(self, times: Bool[np.ndarray, " times"]) -> Missed:
        """Leave out a large part of all data, such as those at one turntable angle."""

    @abstractmethod
    def product(self, number: int) -> Missed:
        """Leave out all data of one product."""


def log_det_of(root: Float[np.ndarray, "n n"]) -> float:
    """ln|M| of a matrix with this Cholesky factor; entries off the diagonal are not read."""
    return 2.0 * float(np.log(np.diagonal(root)).sum())
