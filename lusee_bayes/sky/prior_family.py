"""Families of Gaussian priors: m ~ N(mean, S(theta)), with parameters theta that data can tell.

What learning theta needs of a family are S and sums over its derivatives, ::

    d ln p(d) / d theta_i = 1/2 tr[(dS / d theta_i) (g g^T - F)],
    g = S^-1 (mean of m - prior mean),    F = S^-1 - S^-1 C S^-1,

C being the posterior covariance. F is the covariance of g where the family holds, so that the
Fisher information is the covariance of 1/2 h^T (dS / d theta_i) h over draws h ~ N(0, F).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.special import (
    gammainc,
    gammaincc,
    gammainccinv,
    gammaincinv,
    gammaln,
    ndtr,
    ndtri,
    stdtr,
    stdtrit,
)

from lusee_bayes.sky.priors import Prior

# degrees of freedom of the parameters' Student distribution: near their centre they are held as by
# a normal one of the same width, and a few may be far from it
FREEDOM = 2.0

# variance of parameters' linear combinations, one a row
Spread = Callable[[Float[np.ndarray, "rows parameters"]], Float[np.ndarray, " rows"]]


@dataclass(frozen=True)
class Hyperprior:
    """What is expected of a family's parameters: theta, and then the logarithms of cells' scales.

    Each theta follows a Student distribution with two degrees of freedom. The logarithm t of a
    factor of the variance in a cell has the density ::

        p(t) ~ exp(-tail t - (tail / steepness) exp(-steepness t)),

    greatest at t = 0: a power law towards large factors, and little room for small ones.

    Attributes
    ----------
    centre, width : (theta,) array
    n_cells : int
    tail : float
        The factor's density falls as its power -(1 + tail).
    steepness : float
        Its power is gamma distributed with the inverse scale, tail / steepness.
    """

    centre: Float[np.ndarray, " theta"]
    width: Float[np.ndarray, " theta"]
    n_cells: int = 0
    tail: float = 1.5
    steepness: float = 2.0

    @property
    def size(self) -> int:
        """Number of parameters, with the cells'."""
        return len(self.centre) + self.n_cells

    def start(self) -> Float[np.ndarray, " parameters"]:
        """Return the most probable parameters."""
        return np.concatenate([self.centre, np.zeros(self.n_cells)])

    def log_density(self, parameters: Float[np.ndarray, " parameters"]) -> float:
        """Compute ln p(theta, t)."""
        return float(self._log_densities(parameters).sum())

    def _log_densities(
        self, parameters: Float[np.ndarray, " parameters"]
    ) -> Float[np.ndarray, " parameters"]:
        z, t = self._parts(parameters)
        half = FREEDOM / 2.0
        theta = -(half + 0.5) * np.log1p(z**2 / FREEDOM) - np.log(self.width)
        constant = gammaln(half + 0.5) - gammaln(half) - 0.5 * np.log(FREEDOM * np.pi)
        shape = self.tail / self.steepness
        cells = -self.tail * t - shape * np.exp(-self.steepness * t)
        of_cell = np.log(self.steepness) + shape * np.log(shape) - gammaln(shape)
        return np.concatenate([theta + constant, cells + of_cell])

    def gradient(
        self, parameters: Float[np.ndarray, " parameters"]
    ) -> Float[np.ndarray, " parameters"]:
        """Compute its derivative."""
        z, t = self._parts(parameters)
        theta = -(FREEDOM + 1.0) * z / (FREEDOM + z**2) / self.width
        return np.concatenate([theta, self.tail * np.expm1(-self.steepness * t)])

    def curvature(
        self, parameters: Float[np.ndarray, " parameters"]
    ) -> Float[np.ndarray, " parameters"]:
        """Compute positive second derivatives of -ln p, of a normal density that touches p.

        That of theta is p's own at the centre and goes with the slope where p is not concave.
        """
        z, t = self._parts(parameters)
        theta = (FREEDOM + 1.0) / (FREEDOM + z**2) / self.width**2
        cells = self.tail * self.steepness * np.exp(-self.steepness * t)
        return np.concatenate([theta, cells])

    def scores(
        self, parameters: Float[np.ndarray, " parameters"]
    ) -> Float[np.ndarray, " parameters"]:
        """Compute z with Phi(z) = P(parameter is smaller), one by one: standard normal."""
        x, t = self._parts(parameters)
        shape = self.tail / self.steepness
        # the smaller of both tails keeps its digits
        theta = np.sign(x) * -ndtri(stdtr(FREEDOM, -np.abs(x)))
        power = shape * np.exp(-self.steepness * t)
        below, above = gammaincc(shape, power), gammainc(shape, power)
        cells = np.where(below < above, ndtri(below), -ndtri(above))
        return np.concatenate([theta, cells])

    def of_scores(
        self, scores: Float[np.ndarray, " parameters"]
    ) -> Float[np.ndarray, " parameters"]:
        """Compute the inverse of :meth:`scores`."""
        x, t = np.split(scores, [len(self.centre)])
        shape = self.tail / self.steepness
        theta = np.sign(x) * -stdtrit(FREEDOM, ndtr(-np.abs(x)))
        power = np.where(t < 0, gammainccinv(shape, ndtr(t)), gammaincinv(shape, ndtr(-t)))
        cells = -np.log(power / shape) / self.steepness
        return np.concatenate([self.centre + self.width * theta, cells])

    def slopes_of_scores(
        self, scores: Float[np.ndarray, " parameters"]
    ) -> Float[np.ndarray, " parameters"]:
        """Compute d parameter / d score of each: phi(z) over the parameter's density."""
        log_normal = -0.5 * (scores**2 + np.log(2.0 * np.pi))
        return np.exp(log_normal - self._log_densities(self.of_scores(scores)))

    def _parts(
        self, parameters: Float[np.ndarray, " parameters"]
    ) -> tuple[Float[np.ndarray, " theta"], Float[np.ndarray, " cells"]]:
        theta, cells = np.split(parameters, [len(self.centre)])
        return (theta - self.centre) / self.width, cells


class Member(ABC):
    """The prior of a family at some parameters, and how its S changes with them."""

    @property
    @abstractmethod
    def covariance(self) -> Float[np.ndarray, "modes modes"]:
        """S, in K^2."""

    @abstractmethod
    def traces(self, matrix: Float[np.ndarray, "modes modes"]) -> Float[np.ndarray, " parameters"]:
        """Compute 1/2 tr[(dS / d theta_i) F] of a symmetric F, in 1/K^2."""

    @abstractmethod
    def forms(self, columns: Float[np.ndarray, "modes n"]) -> Float[np.ndarray, "parameters n"]:
        """Compute 1/2 h^T (dS / d theta_i) h of each column h, in 1/K."""


class PriorFamily(ABC):
    """Priors N(mean, S(theta)) over harmonic coefficients, in NumPy."""

    @property
    @abstractmethod
    def hyperprior(self) -> Hyperprior:
        """What is expected of the parameters."""

    @property
    @abstractmethod
    def names(self) -> tuple[str, ...]:
        """Names of those parameters that are reported: the first ones."""

    @abstractmethod
    def at(self, parameters: Float[np.ndarray, " parameters"]) -> Member:
        """Return the member of these parameters."""

    def expected(self) -> Prior:
        """Return the prior of the parameters that are most probable before there are data."""
        return self.prior(self.at(self.hyperprior.start()).covariance)

    @abstractmethod
    def averaged(
        self, parameters: Float[np.ndarray, " parameters"], spread: Spread
    ) -> Float[np.ndarray, "modes modes"]:
        """Compute S with the parameters' uncertainty: its variances' means, in K^2.

        Parameters
        ----------
        parameters : (parameters,) array
            Mean of a normal distribution of the parameters.
        spread : callable
            Variance, under it, of linear combinations of the parameters. The logarithms of
            variances are such combinations, so that their means are those of log-normal variables.
        """

    @abstractmethod
    def prior(self, covariance: Float[np.ndarray, "modes modes"]) -> Prior:
        """Return the prior with this S and the family's mean."""

    @abstractmethod
    def start_from(
        self, coarse: PriorFamily, parameters: Float[np.ndarray, " parameters"]
    ) -> Float[np.ndarray, " parameters"]:
        """Return parameters of this family that stand for those of one with a lower lmax.

        Parameters
        ----------
        coarse : PriorFamily
            The same kind, with a lower lmax.
        parameters : (parameters,) array
            Of ``coarse``.
        """
