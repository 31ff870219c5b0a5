"""Evidence with a prior's parameters integrated out by importance sampling: a check of Laplace's.

::

    p(d) = < p(d, z) / q(z) >,    z ~ q,

with z the parameters' normal scores (:mod:`.normal_scores`) and q a Student distribution of them,
about as wide as Laplace's approximation says and heavier in the tails. The error is told by the
weights' scatter. It is itself unreliable where few draws carry all of the weight: with hundreds of
parameters, of which some are not normally distributed, that is the rule.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.special import gammaln

from lusee_bayes.core.arrays import on_host
from lusee_bayes.core.errors import InputError
from lusee_bayes.core.threads import in_threads
from lusee_bayes.linear.information import Information
from lusee_bayes.linear.learning import Learned
from lusee_bayes.linear.normal_scores import NormalScores
from lusee_bayes.sky.prior_family import PriorFamily

# with fewer effective draws the error of an estimate is not to be trusted
TRUSTED = 20.0
# the others are not drawn if, of so many first ones, fewer than HOPELESS count
PILOT, HOPELESS = 40, 3.0
# degrees of freedom of few parameters; of many, twice their number: heavier tails would put nearly
# all draws far from where normally distributed parameters are
TAILS = 8.0


@dataclass(frozen=True)
class LogMean:
    """The logarithm of a mean of weights, and how well it is known.

    Attributes
    ----------
    value : float
    error : float
        Standard error, from the weights' scatter.
    effective : float
        Number of draws of equal weight that would tell as much.
    draws : int
    """

    value: float
    error: float
    effective: float
    draws: int

    @classmethod
    def of(cls, log_weights: Float[np.ndarray, " draws"]) -> LogMean:
        """Of the logarithms of two weights or more; one that is zero has -inf."""
        n, largest = len(log_weights), log_weights.max()
        weights = np.exp(log_weights - largest)
        error = weights.std(ddof=1) / weights.mean() / np.sqrt(n)
        effective = weights.sum() ** 2 / (weights**2).sum()
        return cls(float(largest + np.log(weights.mean())), float(error), float(effective), n)

    @property
    def is_trusted(self) -> bool:
        """Whether enough draws count for the value and its error to mean something."""
        return self.effective >= TRUSTED


def sampled_evidence(
    family: PriorFamily, information: Information, learned: Learned, n: int, seed: int = 1
) -> LogMean:
    """Estimate ln p(d) with the sky and a family's parameters integrated out.

    Parameters
    ----------
    family : PriorFamily
    information : Information
        What the data say of the sky.
    learned : Learned
        The parameters' most probable values, and their covariance.
    n : int
        Number of draws, two or more; no more than 40 are made where these are hopeless.
    seed : int
        Of the draws.

    Returns
    -------
    LogMean
        ln p(d), for data in K.

    Raises
    ------
    InputError
        For fewer than two draws.
    """
    require_draws(n)
    information, size = on_host(information), len(learned.parameters)
    scores = NormalScores.around(family.hyperprior, learned.parameters, learned.covariance)
    freedom = max(TAILS, 2.0 * size)
    rng = np.random.default_rng(seed)
    z = rng.standard_normal((n, size)) * np.sqrt(freedom / rng.chisquare(freedom, (n, 1)))

    def log_weight(white: Float[np.ndarray, " parameters"]) -> float:
        try:
            prior = family.prior(family.at(scores.parameters(white)).covariance)
            likelihood = float(information.posterior(prior).log_evidence)
        except InputError:  # S has no Cholesky factor so far out
            return -np.inf
        return likelihood + scores.log_ratio(white) - _log_student(white, freedom)

    first = np.array(in_threads(log_weight, list(z[:PILOT])))
    found = LogMean.of(first)
    if n <= PILOT or found.effective < HOPELESS:
        return found
    rest = np.array(in_threads(log_weight, list(z[PILOT:])))
    return LogMean.of(np.concatenate([first, rest]))


def require_draws(n: int) -> None:
    """InputError for fewer than two draws, which tell no error."""
    if n < 2:
        raise InputError(f"importance sampling needs two draws or more, got {n}")


def _log_student(x: Float[np.ndarray, " n"], freedom: float) -> float:
    """ln of the density of a Student distribution of unit scale."""
    half, n = 0.5 * (freedom + len(x)), len(x)
    constant = gammaln(half) - gammaln(0.5 * freedom) - 0.5 * n * np.log(freedom * np.pi)
    return float(constant - half * np.log1p(x @ x / freedom))
