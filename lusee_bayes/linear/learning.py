"""Learning the parameters of a family of priors from data, by their most probable values.

With the sky integrated out, ln p(d, theta) is maximised by Fisher scoring: its gradient is exact,
its curvature the Fisher information, estimated from simulated data, and that of the hyperprior.
Around the maximum theta is taken for normal; the prior that is returned has the variances' means
over it. The evidence is the integral of p(d, theta) by Laplace's approximation, in coordinates that
know the hyperprior's tails (:mod:`.normal_scores`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from lusee_bayes.core.arrays import on_host
from lusee_bayes.core.errors import InputError
from lusee_bayes.core.linalg import cholesky, inverse_from_cholesky
from lusee_bayes.linear.information import Information
from lusee_bayes.linear.normal_scores import NormalScores
from lusee_bayes.linear.posterior import Posterior
from lusee_bayes.sky.prior_family import Member, PriorFamily
from lusee_bayes.sky.priors import Prior

# the maximum is found when the next step could not add more than this to ln p
SETTLED = 0.03
MAX_STEPS = 60
# longest step of a parameter
LONGEST = 3.0
# shortest part of a step that is tried
SHORTEST = 2.0**-10
# simulated data sets for the Fisher information: while going uphill, and at the top
SIMULATIONS, FINAL_SIMULATIONS = 200, 500
# added to a covariance with eigenvalues from 0 to 1, of which a root is needed: those near 0 are
# wrong by eps times the condition number of Lambda, up to 1e-5, and count for nothing
ROUNDING = 1e-4


@dataclass(frozen=True)
class Learned:
    """A prior whose parameters were learned.

    Attributes
    ----------
    prior : Prior
    names : tuple of str
        Of the first parameters.
    parameters : (parameters,) array
        Most probable values.
    covariance : (parameters, parameters) array
        Of the normal distribution around them.
    log_evidence : float
        ln p(d), with the sky and the parameters integrated out (Laplace).
    steps : int
        Steps that were taken.
    """

    prior: Prior
    names: tuple[str, ...]
    parameters: Float[np.ndarray, " parameters"]
    covariance: Float[np.ndarray, "parameters parameters"]
    log_evidence: float
    steps: int

    def as_rows(self) -> list[dict[str, float | str]]:
        """Name, value and standard deviation of the parameters that have a name."""
        std = np.sqrt(np.diagonal(self.covariance))
        return [
            {"name": name, "value": float(value), "std": float(width)}
            for name, value, width in zip(self.names, self.parameters, std, strict=False)
        ]


@dataclass(frozen=True)
class _Point:
    """What is known of ln p(d, theta) at some theta."""

    parameters: Float[np.ndarray, " parameters"]
    member: Member
    posterior: Posterior
    value: float


def learn(
    family: PriorFamily,
    information: Information,
    start: Float[np.ndarray, " parameters"] | None = None,
    seed: int = 1,
    report: Callable[[int, float], None] | None = None,
) -> Learned:
    """Find the most probable parameters of a family, and the prior that they give.

    Parameters
    ----------
    family : PriorFamily
    information : Information
        What the data say of the sky.
    start : (parameters,) array, optional
        Where to begin; by default with the most probable ones before there are data.
    seed : int
        Of the simulated data.
    report : callable, optional
        Told the number of every step and ln p(d, theta).

    Raises
    ------
    InputError
        If S is not positive definite, or the maximum is not found in 60 steps.
    """
    rng, information = np.random.default_rng(seed), on_host(information)
    here = _at(family, information, family.hyperprior.start() if start is None else start)
    for steps in range(MAX_STEPS + 1):
        if report is not None:
            report(steps, here.value)
        gradient, curvature = _slope(family, here, rng, SIMULATIONS)
        step = np.linalg.solve(curvature, gradient)
        gain = 0.5 * float(gradient @ step)
        if gain < SETTLED:
            return _learned(family, information, here, rng, steps)
        here = _uphill(family, information, here, step * min(1.0, LONGEST / np.abs(step).max()))
    raise InputError(
        f"the prior's parameters did not settle in {MAX_STEPS} steps: the next would still add "
        f"{gain:.2g} to ln p (accepted: {SETTLED:g}); use prior.model=isotropic"
    )


def _at(
    family: PriorFamily, information: Information, parameters: Float[np.ndarray, " parameters"]
) -> _Point:
    member = family.at(parameters)
    posterior = information.posterior(family.prior(member.covariance))
    value = float(posterior.log_evidence) + family.hyperprior.log_density(parameters)
    return _Point(parameters, member, posterior, value)


def _uphill(
    family: PriorFamily,
    information: Information,
    here: _Point,
    step: Float[np.ndarray, " parameters"],
) -> _Point:
    """The end of a step, or of a half, a quarter, ... of it, if ln p is not lower there."""
    part = 1.0
    while part >= SHORTEST:
        try:
            there = _at(family, information, here.parameters + part * step)
        except InputError:  # too far: S has no Cholesky factor there
            there = None
        if there is not None and there.value >= here.value - SETTLED / 10.0:
            return there
        part /= 2.0
    raise InputError(
        "the prior's parameters do not settle: ln p falls along its own gradient, so that rounding "
        "rules it; use prior.model=isotropic"
    )


def _slope(
    family: PriorFamily, here: _Point, rng: np.random.Generator, n: int
) -> tuple[Float[np.ndarray, " parameters"], Float[np.ndarray, "parameters parameters"]]:
    """Gradient of ln p(d, theta), and its expected curvature."""
    prior, posterior, hyperprior = here.posterior.prior, here.posterior, family.hyperprior
    unknown = np.asarray(inverse_from_cholesky(posterior.lower))
    known = np.eye(len(unknown)) - unknown
    expected = prior.whiten_columns(prior.whiten_columns(known).T)
    deviation = posterior.white_mean
    if prior.white_mean is not None:
        deviation = deviation - prior.white_mean
    pull = prior.whiten_columns(deviation[None]).T
    found = here.member.forms(pull)[:, 0] - here.member.traces(expected)
    root = _root(known)
    drawn = prior.whiten_columns((root @ rng.standard_normal((len(root), n))).T).T
    scores = here.member.forms(drawn)
    scores = scores - scores.mean(1, keepdims=True)
    curvature = scores @ scores.T / (n - 1.0)
    curvature[np.diag_indices(len(curvature))] += hyperprior.curvature(here.parameters)
    return found + hyperprior.gradient(here.parameters), curvature


def _root(known: Float[np.ndarray, "n n"]) -> Float[np.ndarray, "n k"]:
    """A root of a covariance with eigenvalues from 0 to 1.

    Of data that are very precise, those near 0 are wrong by more than ``ROUNDING``; then what lies
    outside of 0 to 1 is left out.
    """
    root = cholesky(known + ROUNDING * np.eye(len(known)))
    if np.isfinite(np.diagonal(root)).all():
        return np.tril(root)
    values, vectors = np.linalg.eigh(known)
    return vectors * np.sqrt(np.clip(values, 0.0, 1.0))


def _learned(
    family: PriorFamily,
    information: Information,
    here: _Point,
    rng: np.random.Generator,
    steps: int,
) -> Learned:
    _, curvature = _slope(family, here, rng, FINAL_SIMULATIONS)
    covariance = np.linalg.inv(curvature)

    def spread(rows: Float[np.ndarray, "rows parameters"]) -> Float[np.ndarray, " rows"]:
        return np.einsum("ij,ij->i", rows @ covariance, rows)

    scores = NormalScores.around(family.hyperprior, here.parameters, covariance)
    there = family.prior(family.at(family.hyperprior.of_scores(scores.mean)).covariance)
    evidence = scores.log_evidence(float(information.posterior(there).log_evidence))
    prior = family.prior(family.averaged(here.parameters, spread))
    return Learned(prior, family.names, here.parameters, covariance, evidence, steps)
