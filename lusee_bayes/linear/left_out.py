"""The protocol of what tells how a group of data differs from its prediction by all others.

With K = A S A^T + N the covariance of data under the model and u = K^-1 (d - E[d]), a group s
differs from its prediction by K_ss^-1 u_s, K_ss being a block of K^-1, and ::

    chi^2_s = u_s^T K_ss^-1 u_s.
"""

from __future__ import annotations

from abc import ABC, abstractmethod

import numpy as np
from jaxtyping import Bool, Float


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
    def stretch(self, times: Bool[np.ndarray, " times"]) -> float:
        """Compute chi^2_s of all data of a stretch of time, such as a day."""

    @abstractmethod
    def together(self, times: Bool[np.ndarray, " times"]) -> float:
        """Compute chi^2_s of a large part of all data, such as those at one turntable angle."""

    @abstractmethod
    def product(self, number: int) -> float:
        """Compute chi^2_s of all data of one product."""
