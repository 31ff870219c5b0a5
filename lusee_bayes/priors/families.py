"""Families of Gaussian priors: m ~ N(mean, S(theta)), whose parameters theta data can constrain.

To learn theta, we need S and sums over its derivatives, ::

    d ln p(d) / d theta_i = 1/2 tr[(dS / d theta_i) (g g^T - F)],
    g = S^-1 (mean of m - prior mean),    F = S^-1 - S^-1 C S^-1,

where C is the posterior covariance. If the family is correct, F is the covariance of g, and the
Fisher information is the covariance of 1/2 h^T (dS / d theta_i) h over draws h ~ N(0, F).

A learned C_ell has an amplitude, a tilt, a curvature and departures at half octaves, ::

    ln C_ell = a + tilt x + curvature x^2 / 2 + sum_k d_k hat_k(x),    x = ln((ell + 1) / 10).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import numpy as np
from jaxtyping import Float
from scipy import special

from lusee_bayes.core.arrays import Ells, ModesMatrix, Square
from lusee_bayes.core.harmonics import per_mode, sum_over_m
from lusee_bayes.sky.prior import PIVOT, HarmonicPrior, Prior

# arrays that recur
Parameters = Float[np.ndarray, " parameters"]

Basis = Float[np.ndarray, "ells parameters"]

Scored = Float[np.ndarray, "*n parameters"]

Theta = Float[np.ndarray, " theta"]
# degrees of freedom of the parameters' Student distribution: near the centre it acts like a normal
# distribution of the same width, but a few parameters may be far from it
FREEDOM = 2.0

# distance in ln(ell + 1) of the knots of departures
SPACING = 0.5 * np.log(2.0)

# Diffuse Galactic emission falls as ell^-2.4 to ell^-3.1 (La Porta et al. 2008, A&A 479, 641), with
# little curvature. The hyperprior's tails leave room for skies that are unlike it.
TILT, TILT_WIDTH = -2.7, 0.2
CURVATURE_WIDTH, DEPARTURE_WIDTH = 0.3, 0.15
# standard deviation of ln C at the pivot: nearly unconstrained
LOG_AMPLITUDE_WIDTH = 6.0
# standard deviation of ln C_0, which does not follow the spectrum's form
LOG_MONOPOLE_WIDTH = 2.0
# expected fluctuations relative to the mean
RELATIVE_STRENGTH = 0.05

# the density of a cell's factor falls as factor^-(1 + TAIL); factor^-STEEPNESS is gamma
# distributed, with shape and rate SHAPE
TAIL, STEEPNESS = 1.5, 2.0
SHAPE = TAIL / STEEPNESS
# nodes of the Gauss-Hermite rule for the means of cells' factors
NODES = 20


@dataclass(frozen=True)
class Hyperprior:
    """Prior of a family's parameters: theta, then the logarithms of the cells' scales.

    Each theta follows a Student distribution with two degrees of freedom. The logarithm t of a
    factor of the variance in a cell has the density ::

        p(t) ~ exp(-TAIL t - SHAPE exp(-STEEPNESS t)),

    which peaks at t = 0: a power law towards large factors, and a steep fall towards small ones.

    Attributes
    ----------
    centre, width : (theta,) array
    n_cells : int
    """

    centre: Theta
    width: Theta
    n_cells: int = 0

    @property
    def size(self) -> int:
        """Number of parameters, including the cells'."""
        return len(self.centre) + self.n_cells

    def start(self) -> Parameters:
        """Return the most probable parameters."""
        return np.concatenate([self.centre, np.zeros(self.n_cells)])

    def log_density(self, parameters: Parameters) -> float:
        """Compute ln p(theta, t)."""
        return float(self._log_densities(parameters).sum())

    def _log_densities(self, parameters: Parameters) -> Parameters:
        z, t = self._parts(parameters)
        h = FREEDOM / 2.0
        theta = -(h + 0.5) * np.log1p(z**2 / FREEDOM) - np.log(self.width)
        constant = special.gammaln(h + 0.5) - special.gammaln(h) - 0.5 * np.log(FREEDOM * np.pi)
        cells = -TAIL * t - SHAPE * np.exp(-STEEPNESS * t)
        of_cell = np.log(STEEPNESS) + SHAPE * np.log(SHAPE) - special.gammaln(SHAPE)
        return np.concatenate([theta + constant, cells + of_cell])

    def gradient(self, parameters: Parameters) -> Parameters:
        """Compute the derivative of ln p(theta, t)."""
        z, t = self._parts(parameters)
        theta = -(FREEDOM + 1.0) * z / (FREEDOM + z**2) / self.width
        return np.concatenate([theta, TAIL * np.expm1(-STEEPNESS * t)])

    def curvature(self, parameters: Parameters) -> Parameters:
        """Compute second derivatives of -ln p, all positive: of a normal density that touches p.

        For theta: the slope over the distance from the centre, which stays positive everywhere.
        """
        z, t = self._parts(parameters)
        theta = (FREEDOM + 1.0) / (FREEDOM + z**2) / self.width**2
        return np.concatenate([theta, TAIL * STEEPNESS * np.exp(-STEEPNESS * t)])

    def scores(self, parameters: Parameters) -> Parameters:
        """Compute the standard normal score z of each: Phi(z) = P(parameter is smaller)."""
        x, t = self._parts(parameters)
        # the smaller of the two tails keeps its digits
        theta = np.sign(x) * -special.ndtri(special.stdtr(FREEDOM, -np.abs(x)))
        power = SHAPE * np.exp(-STEEPNESS * t)
        below, above = special.gammaincc(SHAPE, power), special.gammainc(SHAPE, power)
        cells = np.where(below < above, special.ndtri(below), -special.ndtri(above))
        return np.concatenate([theta, cells])

    def of_scores(self, scores: Scored) -> Scored:
        """Compute the inverse of :meth:`scores`."""
        x, t = np.split(scores, [len(self.centre)], axis=-1)
        theta = np.sign(x) * -special.stdtrit(FREEDOM, special.ndtr(-np.abs(x)))
        above = special.gammainccinv(SHAPE, special.ndtr(t))
        below = special.gammaincinv(SHAPE, special.ndtr(-t))
        cells = -np.log(np.where(t < 0, above, below) / SHAPE) / STEEPNESS
        return np.concatenate([self.centre + self.width * theta, cells], axis=-1)

    def near(self, scores: Parameters, drawn: Scored) -> Scored:
        """Compute the parameters of drawn scores, theta to first order about given scores.

        A cell's factor has a mean; the exponential of a Student variable has none.
        """
        values, n = self.of_scores(drawn), len(self.centre)
        linear = self.of_scores(scores) + self.slopes_of_scores(scores) * (drawn - scores)
        values[..., :n] = linear[..., :n]
        return values

    def moments(self, scores: Parameters, covariance: Square) -> tuple[Parameters, Square]:
        """Compute mean and covariance of :meth:`near` for normal scores; correlations are kept."""
        nodes, weights = np.polynomial.hermite_e.hermegauss(NODES)
        std = np.sqrt(np.diagonal(covariance))
        values = self.near(scores, scores + nodes[:, None] * std)
        mean, square = (weights @ values**k / weights.sum() for k in (1, 2))
        scale = np.sqrt(square - mean**2) / std
        return mean, scale[:, None] * covariance * scale

    def slopes_of_scores(self, scores: Parameters) -> Parameters:
        """Compute each d parameter / d score: phi(z) over the parameter's density."""
        log_normal = -0.5 * (scores**2 + np.log(2.0 * np.pi))
        return np.exp(log_normal - self._log_densities(self.of_scores(scores)))

    def _parts(self, parameters: Parameters) -> tuple[Theta, Float[np.ndarray, " cells"]]:
        theta, cells = np.split(parameters, [len(self.centre)])
        return (theta - self.centre) / self.width, cells


class Member(ABC):
    """The prior of a family at some parameters, and how its S changes with them."""

    @property
    @abstractmethod
    def covariance(self) -> ModesMatrix:
        """S, in K^2."""

    @abstractmethod
    def traces(self, matrix: ModesMatrix) -> Parameters:
        """Compute 1/2 tr[(dS / d theta_i) F] of a symmetric F, in 1/K^2."""

    @abstractmethod
    def forms(self, columns: Float[np.ndarray, "modes n"]) -> Float[np.ndarray, "parameters n"]:
        """Compute 1/2 h^T (dS / d theta_i) h of each column h, in 1/K."""


class PriorFamily(ABC):
    """Priors N(mean, S(theta)) over harmonic coefficients, in NumPy.

    Attributes
    ----------
    names : tuple of str
        Of the reported parameters, which come first.
    mean : (modes,) array or None
        Common mean of the priors, in K; None for zero.
    hyperprior : Hyperprior
        Prior of the parameters.
    """

    names: ClassVar[tuple[str, ...]] = ("ln C at ell = 9", "tilt", "curvature")
    mean: Float[np.ndarray, " modes"] | None
    hyperprior: Hyperprior

    @abstractmethod
    def at(self, parameters: Parameters) -> Member:
        """Return the member with these parameters."""

    def expected(self) -> Prior:
        """Return the prior with the most probable parameters under the hyperprior."""
        return self.prior(self.at(self.hyperprior.start()).covariance)

    @abstractmethod
    def averaged(self, parameters: Parameters, covariance: Square) -> ModesMatrix:
        """Compute S averaged over uncertain parameters: the means of its variances, in K^2.

        Logarithms of variances are linear in the parameters, so that variances are log-normal.

        Parameters
        ----------
        parameters : (parameters,) array
            Mean of a normal distribution of the parameters.
        covariance : (parameters, parameters) array
            Its covariance.
        """

    @abstractmethod
    def prior(self, covariance: ModesMatrix) -> Prior:
        """Return the prior with this S and the family's mean."""

    @abstractmethod
    def start_from(self, coarse: PriorFamily, parameters: Parameters) -> Parameters:
        """Convert the parameters of a family with a lower lmax to this family.

        Parameters
        ----------
        coarse : PriorFamily
            The same kind, with a lower lmax.
        parameters : (parameters,) array
            Of ``coarse``.
        """


def spectrum_basis(temperature: float, lmax: int) -> tuple[Basis, Parameters, Parameters]:
    """Make ln C_ell as a linear function of its parameters.

    Parameters
    ----------
    temperature : float
        Mean of the sky in K, to which expected fluctuations are relative.
    lmax : int

    Returns
    -------
    (ells, parameters) array
    (parameters,), (parameters,) array
        Centre and width of the parameters' prior.
    """
    power = 4.0 * np.pi * (RELATIVE_STRENGTH * temperature) ** 2 / 100.0
    x = np.log((np.arange(lmax + 1) + 1.0) / PIVOT)
    knots = np.arange(x[min(1, lmax)], x[-1] + SPACING, SPACING)
    hats = np.maximum(0.0, 1.0 - np.abs(x[:, None] - knots) / SPACING)
    basis = np.column_stack([np.ones(lmax + 1), x, 0.5 * x**2, hats])
    departures = np.full(len(knots), DEPARTURE_WIDTH)
    centre = np.concatenate([[np.log(power), TILT, 0.0], np.zeros(len(knots))])
    width = np.concatenate([[LOG_AMPLITUDE_WIDTH, TILT_WIDTH, CURVATURE_WIDTH], departures])
    return basis, centre, width


@dataclass(frozen=True)
class IsotropicFamily(PriorFamily):
    """S = diag(C_ell), with C_ell of :func:`spectrum_basis` for ell > 0 and a separate C_0.

    Attributes
    ----------
    basis : (ells, parameters) array
        ln C_ell as a linear function of the parameters; that of C_0 is the last.
    """

    mean: ClassVar[None] = None
    basis: Basis
    hyperprior: Hyperprior

    @classmethod
    def around(cls, temperature: float, lmax: int) -> IsotropicFamily:
        """Make the family for skies with about this mean temperature, in K."""
        basis, centre, width = spectrum_basis(temperature, lmax)
        basis[0] = 0.0
        centre = np.append(centre, np.log(4.0 * np.pi * temperature**2))
        hyperprior = Hyperprior(centre, np.append(width, LOG_MONOPOLE_WIDTH))
        return cls(np.column_stack([basis, np.arange(lmax + 1) == 0]), hyperprior)

    def at(self, parameters: Parameters) -> IsotropicMember:
        return IsotropicMember(self, parameters)

    def averaged(self, parameters, covariance):
        spread = np.einsum("ij,ij->i", self.basis @ covariance, self.basis)
        return np.diag(per_mode(np.exp(self.basis @ parameters + 0.5 * spread)))

    def prior(self, covariance):
        lmax = self.basis.shape[0] - 1
        return HarmonicPrior(np.diagonal(covariance)[np.arange(lmax + 1) ** 2].copy())

    def start_from(self, coarse, parameters):
        more = np.zeros(self.hyperprior.size - len(parameters))
        return np.concatenate([parameters[:-1], more, parameters[-1:]])


@dataclass(frozen=True)
class IsotropicMember(Member):
    """One prior of :class:`IsotropicFamily`."""

    family: IsotropicFamily
    parameters: Parameters

    @cached_property
    def spectrum(self) -> Ells:
        """C_ell, in K^2."""
        return np.exp(self.family.basis @ self.parameters)

    @property
    def covariance(self):
        return np.diag(per_mode(self.spectrum))

    def traces(self, matrix):
        return self.family.basis.T @ (0.5 * self.spectrum * sum_over_m(np.diagonal(matrix)))

    def forms(self, columns):
        return self.family.basis.T @ (0.5 * self.spectrum[:, None] * sum_over_m((columns**2).T).T)
