"""HMC as an independent check of the analytic posterior: mean, variances and covariance.

Every threshold is what exact draws of the analytic posterior would exceed once in ``1 /
FALSE_ALARM`` runs, given how many draws there are and how they hang together in time:

* means: the largest of the modes' deviations in units of their Monte Carlo errors;
* variances: the same for chi^2 of each mode's sample variance, with its own effective sample size;
* covariance: the extreme eigenvalues of the draws' covariance in the analytic posterior's
  coordinates (the generalised eigenvalues of the two), against those of simulated exact chains
  that move as far from draw to draw as the real ones. Even exact draws spread widely here:
  independent ones over (1 +- sqrt(modes / draws))^2 (Marchenko & Pastur 1967).

The sampler's own diagnostics are judged as is common (Vehtari et al. 2021; Betancourt 2016), but
for R-hat, whose largest value among thousands of modes passes 1.01 by chance.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from arviz_stats.base import array_stats
from jaxtyping import Bool, Float
from scipy import stats

from lusee_bayes.core.checks import require_shape
from lusee_bayes.core.errors import InputError
from lusee_bayes.linear.posterior import Posterior
from lusee_bayes.sampling.least import require_draws

# chance that a true posterior fails one of the three comparisons
FALSE_ALARM = 1e-3

MAX_RHAT = 1.01
MIN_ESS_PER_CHAIN = 100
MIN_BFMI = 0.3

# simulated chains for the eigenvalues that chance allows; their extremes scatter little, so that a
# margin of 6 standard deviations of few is safe
NULL_RUNS = 12
NULL_MARGIN = 6.0


@dataclass(frozen=True)
class Check:
    """One number with the interval that it must lie in.

    Attributes
    ----------
    name : str
        Short name.
    value : float
        The number.
    lower, upper : float
        The interval.
    meaning : str
        What the number is.
    """

    name: str
    value: float
    lower: float
    upper: float
    meaning: str

    @property
    def passed(self) -> bool:
        """Whether the value lies in the interval; NaN does not."""
        return bool(self.lower <= self.value <= self.upper)


@dataclass(frozen=True)
class Comparison:
    """Draws against the analytic posterior, mode by mode.

    Attributes
    ----------
    mean_z : (modes,) array
        Difference of the means over its Monte Carlo error.
    variance_ratio, variance_error : (modes,) array
        Variance of the draws over the analytic one, and its error.
    eigenvalues : (modes,) array
        Of the draws' covariance in analytic coordinates, rising.
    null_eigenvalues : (modes,) array
        The same of simulated exact chains, their mean.
    rhat, ess_bulk, ess_tail : (modes,) array
        ArviZ's diagnostics.
    checks : tuple of Check
        The verdict in single numbers.
    """

    mean_z: Float[np.ndarray, " modes"]
    variance_ratio: Float[np.ndarray, " modes"]
    variance_error: Float[np.ndarray, " modes"]
    eigenvalues: Float[np.ndarray, " modes"]
    null_eigenvalues: Float[np.ndarray, " modes"]
    rhat: Float[np.ndarray, " modes"]
    ess_bulk: Float[np.ndarray, " modes"]
    ess_tail: Float[np.ndarray, " modes"]
    checks: tuple[Check, ...]

    @property
    def passed(self) -> bool:
        """Whether every check passed."""
        return all(check.passed for check in self.checks)


def validate_draws(
    draws: Float[np.ndarray, "chains draws modes"],
    posterior: Posterior,
    diverging: Bool[np.ndarray, "chains draws"],
    energy: Float[np.ndarray, "chains draws"],
    *,
    seed: int = 0,
) -> Comparison:
    """Compare draws of the sky by HMC with the analytic posterior.

    Parameters
    ----------
    draws : (chains, draws, modes) array
        Skies, in K.
    posterior : Posterior
        The analytic posterior.
    diverging : (chains, draws) array of bool
        Whether the trajectory to each draw diverged.
    energy : (chains, draws) array
        Of each draw.
    seed : int
        Of the simulated chains whose eigenvalues are compared with.

    Raises
    ------
    InputError
        For draws of another number of modes, fewer than 100 of a chain, or not finite.
    """
    require_shape("the draws", draws, (None, None, posterior.prior.size))
    require_draws(draws.shape[1])
    if not np.isfinite(draws).all():
        raise InputError("the draws hold NaN or infinity; their chains have failed")
    n_chains, _, n_modes = draws.shape
    std = np.asarray(posterior.std())
    deviations = (draws - np.asarray(posterior.mean)) / std
    mean_z = deviations.mean((0, 1)) * np.sqrt(_ess(deviations, "mean"))
    variance_ratio = (deviations**2).mean((0, 1))
    ess_square = _ess(deviations**2, "mean")
    variance_z = _chi2_z(variance_ratio, ess_square)
    white = np.asarray(posterior.whiten(draws.reshape(-1, n_modes))).reshape(draws.shape)
    eigenvalues = _eigenvalues(white)
    null = _null_eigenvalues(white, np.random.default_rng(seed))
    rhat, bulk, tail = _rhat(draws), _ess(draws, "bulk"), _ess(draws, "tail")
    limit = float(stats.norm.isf(FALSE_ALARM / (2 * n_modes)))
    spread = NULL_MARGIN * null.std(0, ddof=1)
    low, high = null.mean(0)[0] - spread[0], null.mean(0)[-1] + spread[-1]
    total = NULL_MARGIN * float(null.mean(1).std(ddof=1))
    ess_floor = float(MIN_ESS_PER_CHAIN * n_chains)
    infinite = float("inf")
    # R-hat^2 - 1 of m half chains is chi^2 with m - 1 degrees over ESS: the largest of many modes
    halves = 2 * n_chains
    chance = stats.chi2.isf(FALSE_ALARM / n_modes, halves - 1) / np.median(ess_square)
    rhat_limit = max(MAX_RHAT, float(np.sqrt(1.0 + halves / (halves - 1) * chance)))
    checks = (
        Check("mean", _largest(mean_z), -limit, limit,
              "largest difference of a mode's means, in Monte Carlo errors"),
        Check("variance", _largest(variance_z), -limit, limit,
              "largest deviation of a mode's variance, as a normal score"),
        Check("covariance, smallest", float(eigenvalues[0]), low, infinite,
              "smallest generalised eigenvalue of the draws' covariance"),
        Check("covariance, largest", float(eigenvalues[-1]), 0.0, high,
              "largest generalised eigenvalue of the draws' covariance"),
        Check("covariance, mean", float(eigenvalues.mean()), 1.0 - total, 1.0 + total,
              "mean generalised eigenvalue: the total variance in analytic coordinates"),
        Check("R-hat", float(rhat.max()), 0.0, rhat_limit, "largest of all modes"),
        Check("bulk ESS", float(bulk.min()), ess_floor, infinite, "smallest of all modes"),
        Check("tail ESS", float(tail.min()), ess_floor, infinite, "smallest of all modes"),
        Check("divergences", float(diverging.sum()), 0.0, 0.0, "diverging trajectories"),
        Check("BFMI", float(_bfmi(energy).min()), MIN_BFMI, infinite,
              "smallest of all chains: how well energies are explored"),
    )  # fmt: skip
    return Comparison(
        mean_z,
        variance_ratio,
        np.sqrt(2.0 / ess_square),
        eigenvalues,
        null.mean(0),
        rhat,
        bulk,
        tail,
        checks,
    )


def _largest(values: Float[np.ndarray, " n"]) -> float:
    return float(values[np.argmax(np.abs(values))])


def _ess(
    draws: Float[np.ndarray, "chains draws modes"], method: str
) -> Float[np.ndarray, " modes"]:
    tails = (0.05, 0.95) if method == "tail" else None
    return np.asarray(array_stats.ess(draws, chain_axis=0, draw_axis=1, method=method, prob=tails))


def _rhat(draws: Float[np.ndarray, "chains draws modes"]) -> Float[np.ndarray, " modes"]:
    return np.asarray(array_stats.rhat(draws, chain_axis=0, draw_axis=1, method="rank"))


def _bfmi(energy: Float[np.ndarray, "chains draws"]) -> Float[np.ndarray, " chains"]:
    """Energy changes between draws over its variance (Betancourt 2016)."""
    return (np.diff(energy, axis=1) ** 2).sum(1) / ((energy.T - energy.mean(1)).T ** 2).sum(1)


def _chi2_z(
    ratio: Float[np.ndarray, " n"], dof: Float[np.ndarray, " n"]
) -> Float[np.ndarray, " n"]:
    """Normal scores of variance ratios that are chi^2 over ``dof``: skewness counts at 5 sigma.

    Where the tail is too small for a float, by Wilson and Hilferty's cube root.
    """
    upper = ratio > 1
    tail = np.where(upper, stats.chi2.sf(ratio * dof, dof), stats.chi2.cdf(ratio * dof, dof))
    far = np.abs(np.cbrt(ratio) - 1.0 + 2.0 / (9.0 * dof)) / np.sqrt(2.0 / (9.0 * dof))
    score = np.where(tail > 0, stats.norm.isf(np.clip(tail, 1e-320, 0.5)), far)
    return np.where(upper, 1.0, -1.0) * score


def _eigenvalues(white: Float[np.ndarray, "chains draws modes"]) -> Float[np.ndarray, " modes"]:
    """Of the second moments about the analytic mean, rising."""
    flat = white.reshape(-1, white.shape[-1])
    return np.linalg.eigvalsh(flat.T @ flat / len(flat))


def _null_eigenvalues(
    white: Float[np.ndarray, "chains draws modes"], rng: np.random.Generator
) -> Float[np.ndarray, "runs modes"]:
    """Eigenvalues of exact chains that turn from draw to draw as far as ``white`` does.

    In white coordinates a trajectory is a turn of all modes by one angle, x' = c x + s p with new
    momenta p; c is the cosine between successive draws. Draws that turn by 180 degrees count once
    in a covariance, though they halve the error of a mean: ESS of the means would mislead here.
    """
    unit = white / np.linalg.norm(white, axis=2, keepdims=True)
    cosine = (unit[:, 1:] * unit[:, :-1]).sum(2)
    # not sqrt(1 - cosine^2), which rounding makes imaginary where a draw is repeated
    sine = np.linalg.norm(unit[:, 1:] - cosine[..., None] * unit[:, :-1], axis=2)
    runs = []
    for _ in range(NULL_RUNS):
        chains = rng.standard_normal(white.shape)
        for t in range(1, white.shape[1]):
            chains[:, t] *= sine[:, t - 1, None]
            chains[:, t] += cosine[:, t - 1, None] * chains[:, t - 1]
        runs.append(_eigenvalues(chains))
    return np.stack(runs)
