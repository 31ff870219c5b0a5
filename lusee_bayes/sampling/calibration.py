"""Simulation-based calibration: does a posterior mean what it says, over many data sets?

Draw a truth from the prior, data from the truth, draws from the posterior given the data; the rank
of the truth among the draws is uniform if and only if the posterior is right (Talts et al. 2018).
What is ranked is a *quantity* of the unknowns, which may depend on the data too: the likelihood
catches posteriors that leave data unused, which single modes cannot (Modrak et al. 2023).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int, Key, PRNGKeyArray
from scipy import stats

from lusee_bayes.core.arrays import Array
from lusee_bayes.core.engine import Engine, Tasks, ThisProcess
from lusee_bayes.core.progress import Stages
from lusee_bayes.linear.levels import LEVELS
from lusee_bayes.linear.model import LinearGaussian
from lusee_bayes.linear.solver import Solver
from lusee_bayes.sampling.least import N_BINS, require_simulations

# ranks among 99 draws take 100 values, so that LEVELS are met exactly
N_DRAWS = 99

# chance that a true posterior fails the verdict over all quantities
FALSE_ALARM = 1e-3

# data sets worked on at once, and the numbers that their draws of the data may take up
BATCH = 50
MEMORY = 10_000_000


@dataclass(frozen=True)
class Ranks:
    """Ranks 0..n_draws of the truth among the draws, for every data set and quantity.

    Attributes
    ----------
    ranks : (simulations, quantities) array of int
        The ranks.
    n_draws : int
        Number of draws.
    names : tuple of str
        Of the quantities.
    regions : tuple of str
        Names of the quantities that grow outwards, like the distance from the mean. Their
        coverage is that of the region inside, for the others that of the central interval.
    """

    ranks: Int[np.ndarray, "simulations quantities"]
    n_draws: int
    names: tuple[str, ...]
    regions: tuple[str, ...] = ()

    @property
    def n_simulations(self) -> int:
        """Number of data sets."""
        return self.ranks.shape[0]

    def histogram(self) -> Int[np.ndarray, "quantities bins"]:
        """Count the ranks in each of 20 equal bins."""
        edges = np.linspace(0, self.n_draws + 1, N_BINS + 1) - 0.5
        return np.stack([np.histogram(r, edges)[0] for r in self.ranks.T])

    def band(self, probability: float = 0.99) -> tuple[int, int]:
        """Return the counts between which a bin of the histogram lies with this probability."""
        low, high = stats.binom.interval(probability, self.n_simulations, 1.0 / N_BINS)
        return int(low), int(high)

    def p_values(self) -> Float[np.ndarray, " quantities"]:
        """Return the p-value of each histogram against a flat one, by chi^2."""
        return stats.chisquare(self.histogram(), axis=1).pvalue

    def coverage(self) -> dict[str, dict[float, float]]:
        """Return the share of truths within the 50, 68, 90 and 95 % regions, by quantity."""
        n = self.n_draws + 1
        middle = self.n_draws / 2
        table = {}
        for name, ranks in zip(self.names, self.ranks.T, strict=True):
            if name in self.regions:
                inside = {p: ranks < p * n for p in LEVELS}
            else:
                off = np.abs(ranks - middle)
                # 95 of 100 ranks do not lie evenly about the middle: the outermost count half
                inside = {p: (off < p * n / 2) + 0.5 * (off == p * n / 2) for p in LEVELS}
            table[name] = {p: float(hit.mean()) for p, hit in inside.items()}
        return table

    def coverage_error(self, level: float) -> float:
        """Return the standard error of a coverage that is right."""
        return float(np.sqrt(level * (1 - level) / self.n_simulations))

    @property
    def threshold(self) -> float:
        """The smallest p-value has to be above this: FALSE_ALARM shared by all quantities."""
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
    one_by_one: bool = False,
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
        Of everything.
    batch : int
        Data sets worked on at once.
    one_by_one : bool
        Work on the data sets of a batch one after the other: where each takes its own time, they
        would all wait for the slowest.
    regions : sequence of str
        See :class:`Ranks`.
    engine : Engine, optional
        What works on the batches; by default this process, on one after the other.
    stages : Stages, optional
        Told how many batches are done.

    Raises
    ------
    InputError
        For fewer than 100 data sets.
    """
    require_simulations(n_simulations)

    def rank(start: int) -> dict[str, np.ndarray]:
        keys = jax.random.split(jax.random.key(seed), n_simulations)[start : start + batch]
        ranks = _rank_batch(simulate, draw, quantities, keys, one_by_one)
        return jax.tree.map(np.asarray, ranks)

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
    return Ranks(np.concatenate(columns, axis=1), N_DRAWS, tuple(names), tuple(regions))


@eqx.filter_jit
def _rank_batch(
    simulate, draw, quantities, keys: Key[Array, " n"], one_by_one: bool
) -> dict[str, Array]:
    """Ranks of one batch of data sets: (simulations, ...) by name."""

    def one(key):
        simulation_key, draw_key = jax.random.split(key)
        truth, data = simulate(simulation_key)
        drawn = jax.vmap(quantities, (0, None))(draw(draw_key, data), data)
        below = jax.tree.map(lambda q, t: (q < t[None]).sum(0), drawn, quantities(truth, data))
        return {name: jnp.atleast_1d(rank) for name, rank in below.items()}

    return jax.lax.map(one, keys) if one_by_one else jax.vmap(one)(keys)


def calibrate_sky(
    truth: LinearGaussian,
    posterior: LinearGaussian,
    *,
    n_simulations: int = 500,
    n_modes: int = 10,
    n_projections: int = 10,
    seed: int = 0,
    engine: Engine | None = None,
    stages: Stages | None = None,
) -> Ranks:
    """Calibrate the analytic posterior of the sky.

    :class:`SkyQuantities` are ranked: single modes spread over the ells, random directions in
    units of the prior, the distance from the mean in the posterior's metric, and the likelihood.

    Parameters
    ----------
    truth : LinearGaussian
        The model that data sets are drawn from.
    posterior : LinearGaussian
        The model that is conditioned on them; usually the same.
    n_simulations : int
        Number of data sets.
    n_modes, n_projections : int
        Number of single modes and of random directions.
    seed : int
        Of everything.
    engine, stages : optional
        As for :func:`calibrate`.

    Raises
    ------
    InputError
        For fewer than 100 data sets.
    """
    solver = posterior.factorise()
    quantities = SkyQuantities.spread(solver, n_modes, n_projections, seed)
    return quantities.rename(
        calibrate(
            truth.sample,
            eqx.Partial(_sky_draws, solver),
            quantities,
            n_simulations=n_simulations,
            seed=seed,
            batch=int(np.clip(MEMORY // (N_DRAWS * posterior.n_data), 1, BATCH)),
            regions=("distance",),
            engine=engine,
            stages=stages,
        )
    )


def _sky_draws(solver: Solver, key: PRNGKeyArray, data: Array) -> Float[Array, "draws modes"]:
    return solver.condition(data).sample(key, N_DRAWS)


class SkyQuantities(eqx.Module):
    """Quantities of a sky: modes, projections, distance from the mean, log likelihood.

    Attributes
    ----------
    solver : Solver
        Of the model that is conditioned on the data.
    modes : tuple of int
        Numbers of the single modes.
    directions : (projections, white) array
        Directions in units of the prior.
    """

    solver: Solver
    modes: tuple[int, ...] = eqx.field(static=True)
    directions: Float[Array, "projections white"]

    @classmethod
    def spread(cls, solver: Solver, n_modes: int, n_projections: int, seed: int) -> SkyQuantities:
        """Choose modes from the lowest to the highest ell, and random directions."""
        size = solver.prior.size
        chosen = np.unique(np.linspace(0, size - 1, min(n_modes, size)).astype(int))
        rng = np.random.default_rng(seed)
        directions = rng.standard_normal((n_projections, solver.prior.rank))
        return cls(solver, tuple(int(c) for c in chosen), jnp.asarray(directions))

    def __call__(self, sky: Float[Array, " modes"], data: Float[Array, " data"]) -> dict:
        """Compute the quantities of one sky, given the data."""
        solver = self.solver
        u = solver.prior.whiten(sky)
        white = solver.factor.whiten(data if solver.offset is None else data - solver.offset)
        return {
            "mode": sky[np.array(self.modes)],
            "projection": self.directions @ u,
            "distance": (solver.condition(data).whiten(sky[None])[0] ** 2).sum(),
            "log likelihood": -0.5 * ((white - solver.whitened @ u) ** 2).sum(),
        }

    def rename(self, ranks: Ranks) -> Ranks:
        """Name the modes of ranks by their number among all modes."""
        numbers = {f"mode {i}": f"mode {mode}" for i, mode in enumerate(self.modes)}
        return replace(ranks, names=tuple(numbers.get(name, name) for name in ranks.names))
