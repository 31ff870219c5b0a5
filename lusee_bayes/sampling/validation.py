"""Tests of the analytic posterior with HMC and with simulated data.

**Simulation-based calibration** tests over many data sets whether a posterior is right. Draw a
truth from the prior, data from the truth, draws from the posterior given the data: the rank of the
truth among the draws is uniform if and only if the posterior is right (Talts et al. 2018). The
ranks are of *quantities* of the unknowns, which may depend on the data, too: the likelihood
detects posteriors that leave data unused, which single modes cannot (Modrak et al. 2023).

**HMC checks the analytic posterior**: mean, variances and covariance. Exact draws of the analytic
posterior would exceed each threshold once in ``1 / FALSE_ALARM`` runs, given the number of draws
and their correlation in time:

* means: the largest of the modes' deviations in units of their Monte Carlo errors;
* variances: the same for chi^2 of each mode's sample variance, with its effective sample size;
* covariance: the extreme eigenvalues of the draws' covariance in the analytic posterior's
  coordinates (the generalised eigenvalues of the two), compared with those of simulated exact
  chains that move as far from draw to draw as the real ones. Even exact draws scatter widely here:
  independent ones over (1 +- sqrt(modes / draws))^2 (Marchenko & Pastur 1967).

The sampler's diagnostics have the usual limits (Vehtari et al. 2021; Betancourt 2016) except for
R-hat, whose largest value among thousands of modes exceeds 1.01 by chance.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from arviz_stats.base import array_stats
from jaxtyping import Bool, Float, Int, Key, PRNGKeyArray
from scipy import stats

from lusee_bayes.core.arrays import Array, Vector
from lusee_bayes.core.checks import require_shape
from lusee_bayes.core.engine import Engine, Tasks, ThisProcess
from lusee_bayes.core.errors import InputError
from lusee_bayes.core.progress import Stages
from lusee_bayes.judge.convergence import AGREE, PER_CHAIN
from lusee_bayes.judge.coverage import LEVELS
from lusee_bayes.linear.linear_gaussian import LinearGaussian, Whitened
from lusee_bayes.linear.posterior import Posterior
from lusee_bayes.sampling.least import N_BINS, require_draws, require_simulations

Skies = Float[np.ndarray, "chains draws modes"]

# ranks among 99 draws have 100 values, which match LEVELS exactly
N_DRAWS = 99

# probability that a correct posterior fails the verdict over all quantities
FALSE_ALARM = 1e-3

# number of single modes of a sky that are ranked, and of random directions
N_RANKED = 10

# data sets computed at once, and the most numbers in their draws of the data
BATCH = 50
MEMORY = 10_000_000


@dataclass(frozen=True)
class Ranks:
    """Ranks 0..N_DRAWS of the truth among the draws, for every data set and quantity.

    Attributes
    ----------
    ranks : (simulations, quantities) array of int
        The ranks.
    names : tuple of str
        Names of the quantities.
    regions : tuple of str
        Names of quantities that grow outwards, like the distance from the mean. Their coverage is
        for the region inside, that of the others for the central interval.
    """

    ranks: Int[np.ndarray, "simulations quantities"]
    names: tuple[str, ...]
    regions: tuple[str, ...] = ()

    @property
    def n_simulations(self) -> int:
        """Number of data sets."""
        return self.ranks.shape[0]

    def histogram(self) -> Int[np.ndarray, "quantities bins"]:
        """Count the ranks in each of 20 equal bins."""
        edges = np.linspace(0, N_DRAWS + 1, N_BINS + 1) - 0.5
        return np.stack([np.histogram(r, edges)[0] for r in self.ranks.T])

    def band(self, probability: float = 0.99) -> tuple[int, int]:
        """Return the interval that contains a bin's count with this probability."""
        low, high = stats.binom.interval(probability, self.n_simulations, 1.0 / N_BINS)
        return int(low), int(high)

    def p_values(self) -> Float[np.ndarray, " quantities"]:
        """Return the p-value of each histogram, from a chi^2 test against a flat one."""
        return stats.chisquare(self.histogram(), axis=1).pvalue

    def coverage(self) -> dict[str, dict[float, float]]:
        """Return the share of truths within the 50, 68, 90 and 95 % regions, by quantity."""
        n, middle = N_DRAWS + 1, N_DRAWS / 2
        table = {}
        for name, ranks in zip(self.names, self.ranks.T, strict=True):
            if name in self.regions:
                inside = {p: ranks < p * n for p in LEVELS}
            else:
                off = np.abs(ranks - middle)
                # 95 of 100 ranks are not symmetric about the middle: the outermost count half
                inside = {p: (off < p * n / 2) + 0.5 * (off == p * n / 2) for p in LEVELS}
            table[name] = {p: float(hit.mean()) for p, hit in inside.items()}
        return table

    def coverage_error(self, level: float) -> float:
        """Return the standard error of a correct coverage."""
        return float(np.sqrt(level * (1 - level) / self.n_simulations))

    @property
    def threshold(self) -> float:
        """Lower limit of the smallest p-value: FALSE_ALARM divided by the number of quantities."""
        return FALSE_ALARM / len(self.names)

    @property
    def passed(self) -> bool:
        """Whether no quantity's ranks are too uneven."""
        return bool(self.p_values().min() > self.threshold)


def calibrate(
    simulate: Callable[[PRNGKeyArray], tuple[Any, Float[Array, " data"]]],
    draw: Callable[[PRNGKeyArray, Float[Array, " data"]], Any],
    quantities: Callable[[Any, Float[Array, " data"]], dict[str, Float[Array, "..."]]],
    *,
    n_simulations: int = 500,
    seed: int = 0,
    batch: int = BATCH,
    regions: Sequence[str] = (),
    engine: Engine | None = None,
    stages: Stages | None = None,
) -> Ranks:
    """Rank the truth among draws of the posterior, for many data sets.

    JAX traces the three functions.

    Parameters
    ----------
    simulate : callable
        key -> (truth, data).
    draw : callable
        (key, data) -> N_DRAWS draws of the unknowns, stacked on the first axis.
    quantities : callable
        (unknowns, data) -> scalars and vectors by name, which are ranked.
    n_simulations : int
        Number of data sets.
    seed : int
        Seed of all random numbers.
    batch : int
        Number of data sets computed at once; all of them wait for the slowest.
    regions : sequence of str
        See :class:`Ranks`.
    engine : Engine, optional
        Where batches are computed; by default in this process, one after the other.
    stages : Stages, optional
        Reports progress.

    Raises
    ------
    InputError
        For fewer than 100 data sets.
    """
    require_simulations(n_simulations)

    def rank(start: int) -> dict[str, np.ndarray]:
        keys = jax.random.split(jax.random.key(seed), n_simulations)[start : start + batch]
        return jax.tree.map(np.asarray, _rank_batch(simulate, draw, quantities, keys))

    starts = range(0, n_simulations, batch)
    names = [f"data sets from {start} on" for start in starts]
    # a compiled batch uses all processors
    engine = engine or ThisProcess(side_by_side=1)
    parts = engine.each(Tasks(rank, starts, names), stages or Stages(), "calibration")
    names, columns = [], []
    for name in parts[0]:
        ranks = np.concatenate([p[name] for p in parts])
        names += [name] if ranks.shape[1] == 1 else [f"{name} {i}" for i in range(ranks.shape[1])]
        columns.append(ranks)
    return Ranks(np.concatenate(columns, axis=1), tuple(names), tuple(regions))


@eqx.filter_jit
def _rank_batch(simulate, draw, quantities, keys: Key[Array, " n"]) -> dict[str, Array]:
    """Ranks for one batch of data sets: (simulations, ...) by name."""

    def one(key):
        simulation_key, draw_key = jax.random.split(key)
        truth, data = simulate(simulation_key)
        drawn = jax.vmap(quantities, (0, None))(draw(draw_key, data), data)
        below = jax.tree.map(lambda q, t: (q < t[None]).sum(0), drawn, quantities(truth, data))
        return {name: jnp.atleast_1d(rank) for name, rank in below.items()}

    return jax.vmap(one)(keys)


def calibrate_sky(
    truth: LinearGaussian,
    posterior: LinearGaussian,
    *,
    n_simulations: int = 500,
    seed: int = 0,
    engine: Engine | None = None,
    stages: Stages | None = None,
) -> Ranks:
    """Calibrate the analytic posterior of the sky.

    It ranks :func:`ranked_of_sky`: single modes spread over the ells, random directions in units of
    the prior, the distance from the mean in the posterior's metric, and the likelihood.

    Parameters
    ----------
    truth : LinearGaussian
        The model from which data sets are drawn.
    posterior : LinearGaussian
        The model that is conditioned on them; usually the same.
    n_simulations : int
        Number of data sets.
    seed : int
        Seed of all random numbers.
    engine, stages : optional
        As for :func:`calibrate`.

    Raises
    ------
    InputError
        For fewer than 100 data sets.
    """
    solver = posterior.factorise()
    size, rng = solver.model.prior.size, np.random.default_rng(seed)
    modes = np.unique(np.linspace(0, size - 1, min(N_RANKED, size)).astype(int))
    directions = rng.standard_normal((N_RANKED, size))
    ranked = eqx.Partial(ranked_of_sky, solver, jnp.asarray(modes), jnp.asarray(directions))
    given = {"n_simulations": n_simulations, "seed": seed, "engine": engine, "stages": stages}
    given["batch"] = int(np.clip(MEMORY // (N_DRAWS * posterior.n_data), 1, BATCH))
    draw = eqx.Partial(_sky_draws, solver)
    ranks = calibrate(truth.sample, draw, ranked, regions=("distance",), **given)
    # modes by their number among all modes
    numbers = {f"mode {i}": f"mode {mode}" for i, mode in enumerate(modes)}
    return replace(ranks, names=tuple(numbers.get(name, name) for name in ranks.names))


def _sky_draws(solver: Whitened, key: PRNGKeyArray, data: Array) -> Float[Array, "draws modes"]:
    return solver.condition(data).posterior.sample(key, N_DRAWS)


def ranked_of_sky(
    solver: Whitened,
    modes: Int[Array, " single"],
    directions: Float[Array, "projections white"],
    sky: Float[Array, " modes"],
    data: Float[Array, " data"],
) -> dict[str, Array]:
    """Compute modes, projections, distance from the mean and log likelihood of a sky, given data.

    Parameters
    ----------
    solver : Whitened
        Solver of the model that is conditioned on the data.
    modes : (single,) array of int
        Numbers of the single modes.
    directions : (projections, white) array
        Directions in units of the prior.
    sky : (modes,) array
        In K.
    data : (data,) array
        In K.
    """
    offset, u = solver.model.offset, solver.model.prior.whiten(sky)
    white = solver.factor.whiten(data if offset is None else data - offset)
    return {
        "mode": sky[modes],
        "projection": directions @ u,
        "distance": (solver.condition(data).posterior.whiten(sky[None])[0] ** 2).sum(),
        "log likelihood": -0.5 * ((white - solver.seen(u)) ** 2).sum(),
    }


MIN_BFMI = 0.3

# number of simulated chains for the eigenvalues' null distribution; their extremes scatter little,
# so a margin of 6 standard deviations from a few chains is safe
NULL_RUNS = 12
NULL_MARGIN = 6.0


@dataclass(frozen=True)
class Check:
    """One number with its allowed interval.

    Attributes
    ----------
    name : str
        Short name.
    value : float
        The number.
    lower, upper : float
        The interval.
    meaning : str
        Meaning of the number.
    """

    name: str
    value: float
    lower: float
    upper: float
    meaning: str

    @property
    def passed(self) -> bool:
        """Whether the value lies in the interval; false for NaN."""
        return bool(self.lower <= self.value <= self.upper)


@dataclass(frozen=True)
class Comparison:
    """Draws compared with the analytic posterior, mode by mode.

    Attributes
    ----------
    mean_z : (modes,) array
        Difference of the means, in Monte Carlo errors.
    variance_ratio, variance_error : (modes,) array
        Ratio of the draws' variance to the analytic one, and its error.
    eigenvalues : (modes,) array
        Eigenvalues of the draws' covariance in analytic coordinates, in increasing order.
    null_eigenvalues : (modes,) array
        Mean eigenvalues of simulated exact chains.
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
    draws: Skies,
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
        Energy of each draw.
    seed : int
        Seed of the simulated chains that give null eigenvalues.

    Raises
    ------
    InputError
        If draws have another number of modes or are not finite, or a chain has fewer than 100.
    """
    require_shape("the draws", draws, (None, None, posterior.prior.size))
    require_draws(draws.shape[1])
    if not np.isfinite(draws).all():
        raise InputError("the draws contain NaN or infinity: their chains have failed")
    n_chains, _, n_modes = draws.shape
    deviations = (draws - np.asarray(posterior.mean)) / np.asarray(posterior.std())
    mean_z = deviations.mean((0, 1)) * np.sqrt(_ess(deviations, method="mean"))
    variance_ratio = (deviations**2).mean((0, 1))
    ess_square = _ess(deviations**2, method="mean")
    variance_z = _chi2_z(variance_ratio, ess_square)
    white = np.asarray(posterior.whiten(draws.reshape(-1, n_modes))).reshape(draws.shape)
    eigenvalues = _eigenvalues(white)
    null = _null_eigenvalues(white, np.random.default_rng(seed))
    rhat = np.asarray(array_stats.rhat(draws, chain_axis=0, draw_axis=1, method="rank"))
    bfmi = array_stats.bfmi(energy, chain_axis=0, draw_axis=1)
    bulk, tail = _ess(draws, method="bulk"), _ess(draws, method="tail", prob=(0.05, 0.95))
    limit = float(stats.norm.isf(FALSE_ALARM / (2 * n_modes)))
    spread = NULL_MARGIN * null.std(0, ddof=1)
    low, high = null.mean(0)[0] - spread[0], null.mean(0)[-1] + spread[-1]
    total = NULL_MARGIN * float(null.mean(1).std(ddof=1))
    ess_floor = float(PER_CHAIN * n_chains)
    # R-hat^2 - 1 of m half chains is a chi^2 of m - 1 degrees / ESS: limit for the largest of modes
    halves = 2 * n_chains
    chance = stats.chi2.isf(FALSE_ALARM / n_modes, halves - 1) / np.median(ess_square)
    rhat_limit = max(AGREE, float(np.sqrt(1.0 + halves / (halves - 1) * chance)))
    checks = (
        Check("mean", _largest(mean_z), -limit, limit,
              "largest difference of a mode's means, in Monte Carlo errors"),
        Check("variance", _largest(variance_z), -limit, limit,
              "largest deviation of a mode's variance, as a normal score"),
        Check("covariance, smallest", float(eigenvalues[0]), low, np.inf,
              "smallest generalised eigenvalue of the draws' covariance"),
        Check("covariance, largest", float(eigenvalues[-1]), 0.0, high,
              "largest generalised eigenvalue of the draws' covariance"),
        Check("covariance, mean", float(eigenvalues.mean()), 1.0 - total, 1.0 + total,
              "mean generalised eigenvalue: the total variance in analytic coordinates"),
        Check("R-hat", float(rhat.max()), 0.0, rhat_limit, "largest of all modes"),
        Check("bulk ESS", float(bulk.min()), ess_floor, np.inf, "smallest of all modes"),
        Check("tail ESS", float(tail.min()), ess_floor, np.inf, "smallest of all modes"),
        Check("divergences", float(diverging.sum()), 0.0, 0.0, "diverging trajectories"),
        Check("BFMI", float(bfmi.min()), MIN_BFMI, np.inf,
              "smallest of all chains: how well energies are explored"),
    )  # fmt: skip
    of_modes = mean_z, variance_ratio, np.sqrt(2.0 / ess_square), eigenvalues, null.mean(0)
    return Comparison(*of_modes, rhat, bulk, tail, checks)


def _largest(values: Float[np.ndarray, " n"]) -> float:
    return float(values[np.argmax(np.abs(values))])


_ess = partial(array_stats.ess, chain_axis=0, draw_axis=1)


def _chi2_z(ratio: Vector, dof: Vector) -> Vector:
    """Normal scores of variance ratios, which are chi^2 / ``dof``: skewness matters at 5 sigma.

    If the tail is too small for a float, Wilson and Hilferty's cube root is used.
    """
    upper = ratio > 1
    tail = np.where(upper, stats.chi2.sf(ratio * dof, dof), stats.chi2.cdf(ratio * dof, dof))
    far = np.abs(np.cbrt(ratio) - 1.0 + 2.0 / (9.0 * dof)) / np.sqrt(2.0 / (9.0 * dof))
    score = np.where(tail > 0, stats.norm.isf(np.clip(tail, 1e-320, 0.5)), far)
    return np.where(upper, 1.0, -1.0) * score


def _eigenvalues(white: Skies) -> Float[np.ndarray, " modes"]:
    """Eigenvalues of the second moments about the analytic mean, in increasing order."""
    flat = white.reshape(-1, white.shape[-1])
    return np.linalg.eigvalsh(flat.T @ flat / len(flat))


def _null_eigenvalues(white: Skies, rng: np.random.Generator) -> Float[np.ndarray, "runs modes"]:
    """Eigenvalues of exact chains that turn from draw to draw as far as ``white`` does.

    In white coordinates a trajectory turns all modes by one angle, x' = c x + s p with new momenta
    p; c is the cosine between successive draws. Draws that turn by 180 degrees count once in a
    covariance, though they reduce the error of a mean: ESS of the means would mislead here.
    """
    unit = white / np.linalg.norm(white, axis=2, keepdims=True)
    cosine = (unit[:, 1:] * unit[:, :-1]).sum(2)
    # not sqrt(1 - cosine^2), which rounding makes imaginary if a draw is repeated
    sine, runs = np.linalg.norm(unit[:, 1:] - cosine[..., None] * unit[:, :-1], axis=2), []
    for _ in range(NULL_RUNS):
        chains = rng.standard_normal(white.shape)
        for t in range(1, white.shape[1]):
            chains[:, t] *= sine[:, t - 1, None]
            chains[:, t] += cosine[:, t - 1, None] * chains[:, t - 1]
        runs.append(_eigenvalues(chains))
    return np.stack(runs)
