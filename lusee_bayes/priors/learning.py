"""Learn the parameters of a family of priors from data, and draw skies with uncertain parameters.

Parameters that the data do not constrain keep the hyperprior, which has heavy tails: Laplace's
approximation misses 0.32 in ln p(d) for every such theta, and 0.11 for every cell. It is exact for
them in normal scores z, theta_i = F_i^-1(Phi(z_i)), where F_i is the hyperprior's distribution
function. ln p(d | theta) is quadratic about the most probable theta*, with slope g and curvature F.
Newton's method, with J = d theta / d z and the precision P = J F J + 1, then maximises ::

    ln p(d, z) = const + g.(theta - theta*) - 1/2 (theta - theta*)^T F (theta - theta*) - 1/2 |z|^2

in two steps. The quadratic form is valid near theta* only: further steps may lead to a spurious
maximum.

With the sky integrated out, Fisher scoring maximises ln p(d, theta). Its gradient is exact. Its
curvature is the Fisher information, estimated from simulated data, plus the hyperprior's, corrected
by how the gradient has changed along earlier steps.
Around the maximum we assume that z is normal, and theta linear in z. Cells' factors are different:
their distribution is skewed, and the mean factor of an unobserved cell is far above the most
probable one. The returned prior has the mean variances over this distribution (their roots within
4 %: a cell's own spread beside that of its neighbours is neglected), at the level that suits the
data best: the data constrain the mean variance over many cells, which the most probable logarithms
do not give. The evidence is Laplace's approximation to the integral of p(d, theta), in normal
scores, which account for the hyperprior's tails.

Draws of a sky include the uncertainty of the parameters, ::

    p(m | d) = int p(m | d, theta) p(theta | d) d theta

The posterior that a run reports is one Gaussian, whose prior has the mean variances over theta. If
the data barely constrain the strength of the sky, its draws all have the same strength. Draws of
p(m | d) are quieter in one sky than in another, and a few departures are far larger. Here z is
drawn from the normal distribution about its most probable value, and skies from the posterior under
each S(theta(z)).
"""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, PRNGKeyArray
from numpy.random import Generator
from scipy.special import logsumexp

from lusee_bayes.core.arrays import Draws, ModesMatrix, Square
from lusee_bayes.core.engine import in_threads
from lusee_bayes.core.errors import InputError, refusing
from lusee_bayes.core.linalg import checked_cholesky, inverse_from_cholesky, solve_lower
from lusee_bayes.judge import measures, split
from lusee_bayes.judge.chi2 import ChiSquare
from lusee_bayes.linear.compressed import Compressed
from lusee_bayes.linear.information import Information
from lusee_bayes.priors.families import Hyperprior, Member, Parameters, PriorFamily
from lusee_bayes.sky.prior import Prior

# steps of Newton's method, each halved until ln p is not lower
STEPS, HALVINGS = 2, 10


@dataclass(frozen=True)
class Scores:
    """The normal distribution of the parameters' normal scores.

    Attributes
    ----------
    mean : (parameters,) array
        Most probable scores.
    covariance : (parameters, parameters) array
        About them.
    log_gain : float
        ln p(d) minus ln p(d | theta) at the most probable parameters (Laplace).
    """

    mean: Parameters
    covariance: Square
    log_gain: float


def normal_scores(hyperprior: Hyperprior, parameters: Parameters, covariance: Square) -> Scores:
    """Transform the normal distribution about the most probable parameters to normal scores.

    Parameters
    ----------
    hyperprior : Hyperprior
    parameters : (parameters,) array
        Most probable values, hyperprior included.
    covariance : (parameters, parameters) array
        Of the normal distribution about them.

    Raises
    ------
    InputError
        If the data's curvature is far from positive definite.
    """
    of_data = np.linalg.inv(covariance) - np.diag(hyperprior.curvature(parameters))
    slope = -hyperprior.gradient(parameters)

    def value(z: Parameters) -> float:
        off = hyperprior.of_scores(z) - parameters
        return float(slope @ off - 0.5 * off @ of_data @ off - 0.5 * z @ z)

    def precision(z: Parameters) -> np.ndarray:
        j = hyperprior.slopes_of_scores(z)
        return j[:, None] * of_data * j + np.eye(len(z))

    z = hyperprior.scores(parameters)
    for _ in range(STEPS):
        pull = slope - of_data @ (hyperprior.of_scores(z) - parameters)
        step = np.linalg.solve(precision(z), hyperprior.slopes_of_scores(z) * pull - z)
        tried = (z + 0.5**k * step for k in range(HALVINGS))
        z = next((trial for trial in tried if value(trial) >= value(z)), z)
    lower = checked_cholesky("the curvature of the parameters", precision(z))
    log_gain = value(z) - float(np.log(np.diagonal(lower)).sum())
    return Scores(z, inverse_from_cholesky(lower), log_gain)


# converged if the next step would add less than this to ln p
SETTLED = 0.03
MAX_STEPS = 60
# a step does not correct the curvature if ln p curves less along it than this part of the expected
STEEP_ENOUGH = 1e-3
# longest step of a parameter
LONGEST = 3.0
# fractions of a step that are tried
FRACTIONS = 0.5 ** np.arange(11)
# simulated data sets for the Fisher information: on the way to the maximum, and at it
SIMULATIONS, FINAL_SIMULATIONS = 200, 500
# multiples of the factor of N that misfitting data demand, tried one after the other
HIGHER = np.array([1.0, 1e2, 1e4])
INFINITE = "the mean of a variance over the prior's uncertain parameters is infinite"
# shifts of ln C at which the evidence of the averaged prior is computed, to find the best one
LEVELS = (-1.0, -0.5, 0.0)
# a level whose standard deviation, given the other parameters, exceeds MEASURED is only limited by
# the data, and FIXED at the mean of its exponential over the shifts LIMITED from the most probable
# level: over a normal distribution, that mean would be far above the limit
MEASURED, FIXED = 1.0, 1e-3
LIMITED = np.arange(-3.0, 12.0)
# how often a fixed prior is widened tenfold if rounding prevents a posterior mean
MOST_WIDENINGS = 4


# name, value and standard deviation of a parameter
Row = dict[str, float | str]


@dataclass(frozen=True)
class Learned:
    """A prior whose parameters were learned.

    Attributes
    ----------
    prior : Prior
    parameters : (parameters,) array
        Most probable values.
    covariance : (parameters, parameters) array
        Of the normal distribution around them.
    scores : Scores
        The normal distribution of their normal scores, from which they are drawn.
    log_evidence : float
        ln p(d), with the sky and the parameters integrated out (Laplace).
    noise_factor : float
        Factor of N with which the parameters were learned; above 1 if the data do not fit.
    settled : bool
        Whether the parameters are learned; otherwise the prior is a fixed, wide one.
    averaged : bool
        Whether the prior is a mean over uncertain parameters; otherwise it has the most probable.
    still_moves : float
        How far the map still moves in the last round (rms, in its standard deviations) if prior
        and N are inferred together; 0 once they have converged.
    survey_rows : tuple of dict
        Name, value and standard deviation of the surveys' parameters.
    survey_gains : tuple of (str, float)
        Name of each survey, and the increase of ln p(d) due to it alone.
    """

    prior: Prior
    parameters: Parameters
    covariance: Square
    scores: Scores
    log_evidence: float
    noise_factor: float = field(default=1.0, kw_only=True)
    settled: bool = field(default=True, kw_only=True)
    averaged: bool = field(default=True, kw_only=True)
    still_moves: float = field(default=0.0, kw_only=True)
    survey_rows: tuple[Row, ...] = field(default=(), kw_only=True)
    survey_gains: tuple[tuple[str, float], ...] = field(default=(), kw_only=True)

    def as_rows(self) -> list[Row]:
        """Name, value and standard deviation of the named parameters, and of surveys."""
        std = np.sqrt(np.diagonal(self.covariance))
        each = zip(PriorFamily.names, self.parameters, std, strict=False)
        rows = [{"name": name, "value": float(x), "std": float(width)} for name, x, width in each]
        return [*rows, *self.survey_rows]


@dataclass(frozen=True)
class _Point:
    """Prior, data and ln p(d, theta) at some theta."""

    parameters: Parameters
    member: Member
    compressed: Compressed
    prior: Prior
    lower: Square
    value: float

    @cached_property
    def response(self) -> Float[np.ndarray, "combinations modes"]:
        """W = L^-1 V^T, with F = W^T W and g = W^T L^-1 q."""
        return solve_lower(self.lower, self.compressed.response, transpose=False)

    def slope(self, family: PriorFamily) -> Parameters:
        """Gradient of ln p(d, theta)."""
        white = solve_lower(self.lower, self.compressed.data[:, None], transpose=False)
        of_data = self.member.forms(self.response.T @ white)[:, 0]
        expected = self.member.traces(self.response.T @ self.response)
        return of_data - expected + family.hyperprior.gradient(self.parameters)

    def curvature(self, family: PriorFamily, rng: Generator, n: int) -> Square:
        """Expected curvature of -ln p(d, theta), from simulated data sets."""
        scores = self.member.forms(self.response.T @ rng.standard_normal((len(self.response), n)))
        scores = scores - scores.mean(1, keepdims=True)
        curvature = scores @ scores.T / (n - 1.0)
        curvature[np.diag_indices(len(curvature))] += family.hyperprior.curvature(self.parameters)
        return curvature


def learn(
    family: PriorFamily, information: Information, start: Parameters | None = None, seed: int = 1
) -> Learned:
    """Find the most probable parameters of a family, and the resulting prior.

    Parameters
    ----------
    family : PriorFamily
    information : Information
        The data's information about the sky.
    start : (parameters,) array, optional
        Where to begin; by default at the maximum of the hyperprior.
    seed : int
        Of the simulated data.

    Raises
    ------
    InputError
        If S is not positive definite, the search does not converge in 60 steps, ln p falls along
        its gradient, or the mean of a variance is infinite.
    """
    rng, path = np.random.default_rng(seed), []
    start = family.hyperprior.start() if start is None else start
    variance = np.diagonal(family.at(start).covariance)
    compressed = Compressed.of(information, family.mean, variance)
    point = _at(family, compressed, start)
    for _ in range(MAX_STEPS + 1):
        gradient = point.slope(family)
        path.append((point.parameters, gradient))
        curvature = _corrected(point.curvature(family, rng, SIMULATIONS), path)
        step = np.linalg.solve(curvature, gradient)
        if (gain := 0.5 * float(gradient @ step)) < SETTLED:
            return _learned(family, compressed, point, rng)
        point = _climb(family, compressed, point, step * min(1.0, LONGEST / np.abs(step).max()))
    raise InputError(
        f"the prior's parameters did not converge in {MAX_STEPS} steps: the next would still add "
        f"{gain:.2g} to ln p (accepted: {SETTLED:g})"
    )


def _corrected(curvature: Square, path: Sequence[tuple[Parameters, Parameters]]) -> Square:
    """Correct the curvature by how the gradient fell along earlier steps (BFGS)."""
    for (start, before), (end, after) in pairwise(path):
        step, fall = end - start, before - after
        along = curvature @ step
        if fall @ step > STEEP_ENOUGH * (step @ along):
            curvature = curvature - np.outer(along, along) / (step @ along)
            curvature = curvature + np.outer(fall, fall) / (fall @ step)
    return curvature


def learn_whatever_fits(
    family: PriorFamily, information: Information, start: Parameters | None = None, seed: int = 1
) -> Learned:
    """Learn a prior as :func:`learn` does, even from data that no sky explains.

    Under N, such data require a sky that is brighter by orders of magnitude, and ln p is rough. N
    is raised by the factor that the residual chi^2, which no sky can absorb, demands; if learning
    fails there, by 100 and 10,000 times that factor. The last resort is a fixed prior: the
    family's expected one, made wide enough for the sky that the data require.

    Parameters
    ----------
    family, information, start, seed
        As for :func:`learn`.
    """
    demanded = demanded_factor(information, family.expected())
    for factor in demanded * HIGHER:
        with suppress(InputError):
            learned = learn(family, information.raised(factor), start, seed)
            if factor > 1.0:  # check that there is a posterior under N itself
                information.posterior(learned.prior).std()
            return replace(learned, noise_factor=float(factor))
    return _fixed(family, information, float(demanded * HIGHER[-1]))


def demanded_factor(information: Information, prior: Prior) -> float:
    """Factor of N that brings the residual chi^2 to its expectation; 1 if it is not too large.

    Parameters
    ----------
    information : Information
    prior : Prior
        Before learning, over the same modes.
    """
    n_data = int(information.n_data)
    try:
        posterior = information.posterior(prior)
        chi2 = float(information.chi2(posterior.mean) + posterior.prior_chi2())
        left = split.Split.of(posterior, chi2, n_data).instrument
    except InputError:  # the data are too far from any sky: rounding dominates these numbers
        left = ChiSquare(float(information.misfit), float(n_data))
    return 1.0 if left.too_small or left.fits else left.chi2 / left.degrees


def _fixed(family: PriorFamily, information: Information, factor: float) -> Learned:
    """The family's expected prior, widened as the data with N raised by a factor require.

    It is widened further if no posterior mean can be computed under N itself: rounding grows with
    the distance from the prior mean, in the prior's standard deviations.
    """
    prior, n_data = family.expected(), int(information.n_data)
    raised = information.raised(factor).posterior(prior)
    n_known = max(n_data - measures.expected_chi2(raised, n_data), 1.0)
    prior = prior.widened(max(1.0, float(np.sqrt(float(raised.prior_chi2()) / n_known))))
    for _ in range(MOST_WIDENINGS):
        try:
            evidence = float(information.posterior(prior).log_evidence)
            none = Scores(np.zeros(0), np.zeros((0, 0)), 0.0)
            return Learned(prior, none.mean, none.covariance, none, evidence, settled=False)
        except InputError as error:
            prior, failed = prior.widened(10.0), error
    raise failed


def _at(family: PriorFamily, compressed: Compressed, parameters: Parameters) -> _Point:
    member = family.at(parameters)
    prior = family.prior(member.covariance)
    lower = compressed.root(compressed.covariance(prior))
    value = compressed.log_evidence(lower) + family.hyperprior.log_density(parameters)
    return _Point(parameters, member, compressed, prior, lower, value)


def _climb(family: PriorFamily, compressed: Compressed, base: _Point, step: Parameters) -> _Point:
    """The end of a step, or of a half, a quarter, ... of it, if ln p is not lower there."""
    for part in FRACTIONS:
        with suppress(InputError):  # too far: S has no Cholesky factor there
            trial = _at(family, compressed, base.parameters + part * step)
            if trial.value >= base.value - SETTLED / 10.0:
                return trial
    wrong = "the prior's parameters do not converge: ln p decreases along its gradient, by rounding"
    raise InputError(wrong)


def _learned(family: PriorFamily, compressed: Compressed, point: _Point, rng: Generator) -> Learned:
    covariance = np.linalg.inv(point.curvature(family, rng, FINAL_SIMULATIONS))
    scores = normal_scores(family.hyperprior, point.parameters, covariance)
    evidence = compressed.log_evidence(point.lower) + scores.log_gain
    first = np.arange(len(covariance)) == 0
    mean, about = family.hyperprior.moments(scores.mean, scores.covariance)
    limited = np.linalg.inv(about)[0, 0] < MEASURED**-2
    if limited:
        others = np.where(np.logical_or.outer(first, first), 0.0, scores.covariance)
        scores = replace(scores, covariance=others + FIXED**2 * np.diag(first))
        mean, about = family.hyperprior.moments(scores.mean, scores.covariance)

    # S is a constant plus a part proportional to the level
    def at_level(shift: float, once: Square, twice: Square) -> Square:
        return once + np.expm1(shift) * (twice - once)

    try:
        with np.errstate(over="raise"), refusing(INFINITE, FloatingPointError):
            both = [family.averaged(mean + by * first, about) for by in (0.0, np.log(2.0))]
        of_data = [compressed.covariance(family.prior(one)) for one in both]
        shifts = LIMITED if limited else LEVELS
        roots = (compressed.root(at_level(by, *of_data)) for by in shifts)
        tried = [compressed.log_evidence(root) for root in roots]
        if limited:
            of_prior = [family.hyperprior.log_density(mean + by * first) for by in LIMITED]
            log_p = np.add(tried, of_prior)
            shift = float(logsumexp(log_p + LIMITED) - logsumexp(log_p))
        else:
            square, linear, _ = np.polyfit(LEVELS, tried, 2)
            shift = -0.5 * linear / square if square < 0 else LEVELS[int(np.argmax(tried))]
            shift = float(np.clip(shift, LEVELS[0] - 1.0, LEVELS[-1] + 1.0))
        prior = family.prior(at_level(shift, *both))
    except InputError:  # too uncertain to be averaged: the most probable values
        prior, shift, still = point.prior, 0.0, FIXED**2 * np.eye(len(mean))
        scores = Scores(family.hyperprior.scores(point.parameters), still, scores.log_gain)
    moved = shift * first / family.hyperprior.slopes_of_scores(scores.mean)[0]
    scores = replace(scores, mean=scores.mean + moved)
    averaged = prior is not point.prior
    return Learned(prior, point.parameters, covariance, scores, evidence, averaged=averaged)


# at most SHARED skies have the same theta, and at most two do until there are LEAST theta
SHARED, LEAST = 30, 10
# draws of theta before giving up, if rounding leaves no positive definite S
ATTEMPTS = 5


def averaged_beyond(family: PriorFamily, coarse: PriorFamily, scores: Scores) -> ModesMatrix:
    """S of a family averaged over parameters that the same kind has learned up to a lower ell.

    Further parameters have the hyperprior: beyond the data, the uncertainty grows.
    """
    places = np.flatnonzero(family.start_from(coarse, np.ones(len(scores.mean))))
    mean, covariance = np.zeros(family.hyperprior.size), np.eye(family.hyperprior.size)
    mean[places], covariance[np.ix_(places, places)] = scores.mean, scores.covariance
    return family.averaged(*family.hyperprior.moments(mean, covariance))


def draws_with_parameters(
    family: PriorFamily, learned: Learned, information: Information, key: PRNGKeyArray, n: int
) -> Draws:
    """Draw skies with uncertain parameters; consecutive skies have different ones.

    Parameters
    ----------
    family : PriorFamily
    learned : Learned
        Its parameters and their uncertainty.
    information : Information
        Of the same data.
    key : PRNG key
    n : int

    Returns
    -------
    (draws, modes) array
        In K.

    Raises
    ------
    InputError
        If S is not positive definite for five theta in a row.
    """
    drawn = np.empty((n, information.n_modes))
    if not n:
        return drawn
    compressed = Compressed.of(information, family.mean, np.asarray(learned.prior.variance()))
    sets = max(min(-(-n // 2), LEAST), -(-n // SHARED))

    def some(k: int) -> None:
        subkey = jax.random.fold_in(key, k)
        few = len(drawn[k::sets])
        drawn[k::sets] = _under_drawn_parameters(family, learned, compressed, subkey, few)

    in_threads(some, range(sets))
    return drawn


def _under_drawn_parameters(
    family: PriorFamily, learned: Learned, compressed: Compressed, key: PRNGKeyArray, n: int
) -> Draws:
    scores, root = learned.scores.mean, np.linalg.cholesky(learned.scores.covariance)
    for attempt in range(ATTEMPTS):
        z = jax.random.normal(jax.random.fold_in(key, attempt), (len(root),), dtype=jnp.float64)
        parameters = family.hyperprior.near(scores, scores + root @ np.asarray(z))
        try:
            prior = family.prior(family.at(parameters).covariance)
            return compressed.sample(prior, jax.random.fold_in(key, ATTEMPTS), n)
        except InputError as error:
            failed = error
    why = f"cannot draw skies with uncertain prior parameters: {failed}; use prior.model=isotropic"
    raise InputError(why)
