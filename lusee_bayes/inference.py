"""Hamiltonian Monte Carlo of any NumPyro program: chains side by side, draws kept as they come.

Programs are sampled in coordinates in which their posterior is nearly round, if such are known
(:mod:`lusee_bayes.coordinates`: those of the sky's analytic posterior, or of
:mod:`lusee_bayes.laplace`); the density is the program's own.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array, PRNGKeyArray
from numpyro import handlers
from numpyro.infer import HMC, NUTS
from numpyro.infer.hmc import HMCState

from lusee_bayes.checkpoints import Checkpoints
from lusee_bayes.checks import AnyArray, InputError, nearest
from lusee_bayes.coordinates import WHITE_SUFFIX, Whitened, Whitening
from lusee_bayes.sites import CorrelatedNormal

ALGORITHMS = ("nuts", "hmc")

# iterations between two files: a few seconds of work at the fiducial size
CHUNK = 25

# deepest tree of NUTS where all coordinates are white
WHITE_DEPTH = 6

# statistics of every draw, by their ArviZ names
STATISTICS: dict[str, Callable[[HMCState], AnyArray]] = {
    "lp": lambda s: -s.potential_energy,
    "energy": lambda s: s.energy,
    "diverging": lambda s: s.diverging,
    "acceptance_rate": lambda s: s.accept_prob,
    "step_size": lambda s: s.adapt_state.step_size,
    "n_steps": lambda s: s.num_steps,
}


@dataclass(frozen=True)
class Sampler:
    """How to sample: ``chains`` times ``draws`` after ``warmup`` iterations, from ``seed``.

    algorithm : "nuts", or "hmc" with trajectories of length ``trajectory`` (pi / 2 makes draws of
    a whitened Gaussian nearly independent); target_accept : for the step size. Where all sites are
    white the metric is known, else warmup learns a diagonal one.
    """

    chains: int = 4
    warmup: int = 150
    draws: int = 1000
    seed: int = 0
    algorithm: str = "nuts"
    target_accept: float = 0.7
    trajectory: float = np.pi / 2

    def __post_init__(self):
        for name, least in [("chains", 1), ("warmup", 20), ("draws", 1)]:
            if getattr(self, name) < least:
                raise InputError(f"{name} must be at least {least}, got {getattr(self, name)}")
        if not 0 < self.target_accept < 1:
            raise InputError(f"target_accept must lie in 0..1, got {self.target_accept}")
        if not self.trajectory > 0:
            raise InputError(f"trajectory must be positive, got {self.trajectory}")
        if self.algorithm not in ALGORITHMS:
            raise InputError(
                f"unknown algorithm '{self.algorithm}'; {nearest(self.algorithm, ALGORITHMS)}"
            )

    def identity(self) -> dict[str, object]:
        """What has to be the same for a run to be resumed: all but the number of draws."""
        return {name: value for name, value in asdict(self).items() if name != "draws"}

    def kernel(self, model: Callable, n_white: int | None) -> HMC:
        """The NumPyro kernel of these settings; ``n_white``: all coordinates, if all are white.

        Then the metric is known, the step size is near 1.5 n^-1/4 (Beskos et al. 2013), and after
        half a period, pi / step, a trajectory only goes round: 2^6 - 1 steps are enough.
        """
        settings: dict[str, Any] = {"target_accept_prob": self.target_accept}
        if n_white is not None:
            settings |= {"adapt_mass_matrix": False, "step_size": 1.5 * n_white**-0.25}
        if self.algorithm == "hmc":
            return HMC(model, trajectory_length=float(self.trajectory), **settings)
        return NUTS(model, max_tree_depth=WHITE_DEPTH if n_white is not None else 10, **settings)


@dataclass(frozen=True)
class Chains:
    """Draws of every site and statistics of every draw, (chains, draws, ...) by name."""

    sites: dict[str, np.ndarray]
    statistics: dict[str, np.ndarray]

    @property
    def gradients(self) -> int:
        """Gradient evaluations behind the draws, all chains together, warmup left out."""
        return int(self.statistics["n_steps"].sum())


def sample(
    program: Callable,
    arguments: Mapping[str, Any],
    sampler: Sampler,
    whitening: Whitening | None = None,
    checkpoints: Checkpoints | None = None,
    report: Callable[[int, HMCState], None] = lambda iteration, state: None,
) -> Chains:
    """Draw from the posterior of ``program(**arguments)``.

    whitening : coordinates of some of its sites; checkpoints : where draws are kept, and found
    again if there are any (the same draws result); report : called with iteration and state after
    each chunk. With several JAX devices the chains are shared out among them, if they go round.
    """
    run = _Run(program, dict(arguments), sampler, whitening)
    done, state, kept = 0, None, []
    previous = None if checkpoints is None else checkpoints.last()
    # NumPyro's own code mixes types and ranks, whatever is asked of ours
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        state = run.start()
        if previous is not None:
            done, state = previous.iteration, run.restore(state, previous.state)
        total = sampler.warmup + sampler.draws
        while done < total:
            limit = sampler.warmup if done < sampler.warmup else total
            n = min(CHUNK, limit - done)
            state, draws = run.advance(state, n)
            done += n
            if done <= sampler.warmup:
                draws = {}
            if checkpoints is None:
                kept.append(draws)
            else:
                checkpoints.append(done, jax.tree.leaves(state), draws)
            report(done, state)
    if checkpoints is not None:
        merged = checkpoints.draws()
    else:
        kept = [k for k in kept if k]
        merged = {
            name: np.concatenate([np.asarray(k[name]) for k in kept]).swapaxes(0, 1)
            for name in kept[0]
        }
    merged = {name: values[:, : sampler.draws] for name, values in merged.items()}
    return Chains(
        {name: values for name, values in merged.items() if name not in STATISTICS},
        {name: merged[name] for name in STATISTICS},
    )


def draw_within(
    program: Callable,
    arguments: Mapping[str, Any],
    key: PRNGKeyArray,
    sampler: Sampler,
    whitening: Whitening | None = None,
    thin: int = 1,
) -> dict[str, Array]:
    """Every ``thin``-th draw of one chain, (draws, ...) by site, as a part of a JAX program.

    To be mapped over many data sets (``jax.vmap``), as in simulation-based calibration; nothing is
    kept on disk. ``sampler``'s chains and seed are not looked at. Call it with NumPy's dtype
    promotion "standard" and rank promotion allowed: NumPyro needs them.
    """
    run = _Run(program, dict(arguments), sampler, whitening)
    kernel, inputs = run.kernel, (run.dynamic,)
    state = kernel.init(key, sampler.warmup, None, inputs, {})

    def iterate(n, state):
        return jax.lax.fori_loop(0, n, lambda _, s: kernel.sample(s, inputs, {}), state)

    def step(state, _):
        state = iterate(thin, state)
        return state, state.z

    _, z = jax.lax.scan(step, iterate(sampler.warmup, state), None, length=sampler.draws)
    return _without_auxiliary(jax.vmap(kernel.postprocess_fn(inputs, {}))(z))


def _without_auxiliary(sites: dict[str, Array]) -> dict[str, Array]:
    return {name: values for name, values in sites.items() if not name.endswith(WHITE_SUFFIX)}


class _Run:
    """A kernel with its model's arguments, and chunks of its iterations compiled once."""

    def __init__(
        self, program: Callable, arguments: dict, sampler: Sampler, whitening: Whitening | None
    ):
        def model(whitening, arguments):
            config = {}
            if whitening is not None:
                config = dict.fromkeys(whitening.names, Whitened(whitening))
            with handlers.reparam(config=config):
                return program(**arguments)

        latent = latent_sites(program, arguments)
        white = set() if whitening is None else set(whitening.names)
        unknown = white - set(latent)
        if unknown:
            raise InputError(
                f"the program has no latent site '{min(unknown)}' to whiten; it has "
                f"{', '.join(latent)}"
            )
        all_white = set(latent) == white
        self.sampler = sampler
        # leaves of the model's arguments that are arrays are traced, the rest is structure
        self.dynamic, static = eqx.partition((whitening, arguments), eqx.is_array)
        self.kernel = sampler.kernel(
            lambda dynamic: model(*eqx.combine(dynamic, static)),
            whitening.root.shape[1] if all_white else None,
        )
        # XLA may stand still over batches of matrices to factorise where cores are few; several
        # devices, each with a chain of its own, would only stand idle
        chart = None if whitening is None else whitening.chart
        factorises = not predicts(program, arguments) or (chart is not None and chart.factorises)
        self.one_by_one = len(jax.local_devices()) == 1 and factorises
        self._advance = jax.jit(self._advance_traced)

    def start(self) -> HMCState:
        """The first state of every chain."""
        keys = jax.random.split(jax.random.PRNGKey(self.sampler.seed), self.sampler.chains)
        if not self.one_by_one:
            state = self.kernel.init(keys, self.sampler.warmup, None, (self.dynamic,), {})
            return self._shared_out(state)

        def first(keys, dynamic):
            return jax.lax.map(
                lambda key: self.kernel.init(key, self.sampler.warmup, None, (dynamic,), {}), keys
            )

        return jax.jit(first)(keys, self.dynamic)

    def restore(self, like: HMCState, leaves: list[np.ndarray]) -> HMCState:
        """The state whose leaves these are; ``like``: any state of this run."""
        arrays = [
            jnp.asarray(new, dtype=old.dtype)
            for new, old in zip(leaves, jax.tree.leaves(like), strict=True)
        ]
        return self._shared_out(jax.tree.unflatten(jax.tree.structure(like), arrays))

    def advance(self, state: HMCState, n: int) -> tuple[HMCState, dict[str, AnyArray]]:
        """``n`` iterations: the state behind them, and the draws (n, chains, ...)."""
        state, rows = self._advance(state, n, self.dynamic)
        return state, {name: values[:n] for name, values in rows.items()}

    def _advance_traced(self, state: HMCState, n, dynamic):
        """The loop's length is traced: every chunk runs one compiled program, whatever n."""

        def collect(state):
            return {"z": state.z} | {name: of(state) for name, of in STATISTICS.items()}

        rows = jax.tree.map(
            lambda x: jnp.zeros((CHUNK, *x.shape), x.dtype), jax.eval_shape(collect, state)
        )

        def sample(state):
            if self.one_by_one:
                return jax.lax.map(lambda s: self.kernel.sample(s, (dynamic,), {}), state)
            return self.kernel.sample(state, (dynamic,), {})

        def step(i, carry):
            state, rows = carry
            state = sample(state)
            return state, jax.tree.map(lambda r, x: r.at[i].set(x), rows, collect(state))

        state, rows = jax.lax.fori_loop(0, n, step, (state, rows))
        constrain = self.kernel.postprocess_fn((dynamic,), {})
        sites = jax.vmap(jax.vmap(constrain))(rows.pop("z"))
        return state, _without_auxiliary(sites) | rows

    def _shared_out(self, state: HMCState) -> HMCState:
        devices = jax.local_devices()
        if len(devices) == 1 or self.sampler.chains % len(devices):
            return state
        mesh = Mesh(np.asarray(devices), ("chain",))
        return jax.device_put(state, NamedSharding(mesh, PartitionSpec("chain")))


def predicts(program: Callable, arguments: dict) -> bool:
    """Whether a program has a site CorrelatedNormal for data: it samples all that they depend on,
    and its density costs products only."""
    return any(isinstance(site["fn"], CorrelatedNormal) for site in _sites(program, arguments))


def latent_sites(program: Callable, arguments: dict) -> list[str]:
    """Names of the sites that a program samples and does not observe."""
    return site_names(program, arguments)[0]


def site_names(program: Callable, arguments: dict) -> tuple[list[str], list[str]]:
    """Names of a program's latent and of its observed sites."""
    latent, observed = [], []
    for site in _sites(program, arguments):
        (observed if site["is_observed"] else latent).append(site["name"])
    return latent, observed


def _sites(program: Callable, arguments: dict) -> list[dict]:
    """The sample sites of a program, without running it."""
    found = []

    def run(dynamic):
        trace = handlers.trace(handlers.seed(program, 0)).get_trace(**eqx.combine(dynamic, static))
        found.extend(site for site in trace.values() if site["type"] == "sample")

    dynamic, static = eqx.partition(arguments, eqx.is_array)
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        jax.eval_shape(run, dynamic)
    return found
