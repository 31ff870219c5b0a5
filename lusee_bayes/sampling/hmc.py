"""Hamiltonian Monte Carlo of any NumPyro program: chains side by side, draws kept as they come.

Programs are sampled in coordinates in which their posterior is nearly round, if such are known
(:mod:`lusee_bayes.sampling.whitening`: those of the sky's analytic posterior, or of
:mod:`lusee_bayes.sampling.mode`); the density is the program's own.
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
from jaxtyping import PRNGKeyArray
from numpyro.infer import HMC, NUTS
from numpyro.infer.hmc import HMCState

from lusee_bayes.core.arrays import Array
from lusee_bayes.core.errors import InputError, nearest
from lusee_bayes.sampling.chains import STATISTICS, Chains
from lusee_bayes.sampling.checkpoints import Checkpoints
from lusee_bayes.sampling.program_sites import latent_sites, predicts
from lusee_bayes.sampling.promotion import numpyro_promotion
from lusee_bayes.sampling.whitening import WHITE_SUFFIX, Whitening, whitened

ALGORITHMS = ("nuts", "hmc")

# iterations between two files: a few seconds of work at the fiducial size
CHUNK = 25

# deepest tree of NUTS where all coordinates are white
WHITE_DEPTH = 6


@dataclass(frozen=True)
class Sampler:
    """How to sample.

    Where all sites are white the metric is known, else warmup learns a diagonal one.

    Attributes
    ----------
    chains : int
        Number of chains.
    warmup : int
        Iterations of each chain that find the step size, and are not kept.
    draws : int
        Draws of each chain that are kept.
    seed : int
        Seed of all chains.
    algorithm : str
        "nuts", or "hmc" with trajectories of a fixed length.
    target_accept : float
        Acceptance rate at which the step size aims.
    trajectory : float
        Length of a trajectory of "hmc"; pi / 2 makes draws of a whitened Gaussian nearly
        independent.

    Raises
    ------
    InputError
        If a setting lies outside its range.
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
        """Return all settings but the number of draws: a run is resumed only with the same."""
        return {name: value for name, value in asdict(self).items() if name != "draws"}

    def kernel(self, model: Callable, n_white: int | None) -> HMC:
        """Make the NumPyro kernel of these settings.

        In white coordinates the metric is known, the step size is near 1.5 n^-1/4, and after
        half a period, pi / step, a trajectory only goes round: 2^6 - 1 steps are enough.

        Parameters
        ----------
        model : callable
            The NumPyro model.
        n_white : int or None
            Number of coordinates if all are white, else None.

        References
        ----------
        Beskos et al. 2013, Bernoulli 19, 1501 (the step size).
        """
        settings: dict[str, Any] = {"target_accept_prob": self.target_accept}
        if n_white is not None:
            settings |= {"adapt_mass_matrix": False, "step_size": 1.5 * n_white**-0.25}
        if self.algorithm == "hmc":
            return HMC(model, trajectory_length=float(self.trajectory), **settings)
        return NUTS(model, max_tree_depth=WHITE_DEPTH if n_white is not None else 10, **settings)


def sample(
    program: Callable,
    arguments: Mapping[str, Any],
    sampler: Sampler,
    whitening: Whitening | None = None,
    checkpoints: Checkpoints | None = None,
    report: Callable[[int, HMCState], None] = lambda iteration, state: None,
) -> Chains:
    """Draw from the posterior of ``program(**arguments)``.

    With several JAX devices, each takes as many chains if the number of chains allows it.

    Parameters
    ----------
    program : callable
        A NumPyro model.
    arguments : mapping
        Its arguments, with the data.
    sampler : Sampler
        How to sample.
    whitening : Whitening, optional
        Coordinates of some of its sites.
    checkpoints : Checkpoints, optional
        Where draws are kept. Draws that are there already are not drawn again; the result is the
        same.
    report : callable
        Called with iteration and state after each chunk.

    Raises
    ------
    InputError
        If ``whitening`` has a site that the program does not sample.
    """
    run = _Run(program, dict(arguments), sampler, whitening)
    done, state, kept = 0, None, []
    previous = None if checkpoints is None else checkpoints.last()
    with numpyro_promotion():
        state = run.start()
        _require_finite(state)
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


@numpyro_promotion()
def draw_within(
    program: Callable,
    arguments: Mapping[str, Any],
    key: PRNGKeyArray,
    sampler: Sampler,
    whitening: Whitening | None = None,
    thin: int = 1,
) -> dict[str, Array]:
    """Draw one chain inside a JAX program.

    It can be mapped over many data sets (``jax.vmap``), as in simulation-based calibration;
    nothing is kept on disk.

    Parameters
    ----------
    program : callable
        A NumPyro model.
    arguments : mapping
        Its arguments, with the data.
    key : PRNG key
        Of the chain.
    sampler : Sampler
        How to sample; its ``chains`` and ``seed`` are not used.
    whitening : Whitening, optional
        Coordinates of some of the program's sites.
    thin : int
        Keep every ``thin``-th draw.

    Returns
    -------
    dict of (draws, ...) array
        Draws by site.
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


NOT_FINITE = (
    "the density is NaN or infinite where the chains begin; look for logarithms and roots of "
    "negative numbers, for scales of zero, and for data outside a support"
)


def _require_finite(state: HMCState) -> None:
    """InputError if the density is NaN or infinite where the chains begin."""
    if not bool(jnp.isfinite(state.potential_energy).all()):
        raise InputError(NOT_FINITE)


def _without_auxiliary(sites: dict[str, Array]) -> dict[str, Array]:
    return {name: values for name, values in sites.items() if not name.endswith(WHITE_SUFFIX)}


class _Run:
    """A kernel with its model's arguments, and chunks of its iterations compiled once."""

    def __init__(
        self, program: Callable, arguments: dict, sampler: Sampler, whitening: Whitening | None
    ):
        def model(whitening, arguments):
            run = program if whitening is None else whitened(program, whitening)
            return run(**arguments)

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
            try:
                state = self.kernel.init(keys, self.sampler.warmup, None, (self.dynamic,), {})
            except RuntimeError as error:
                # NumPyro's word for a density that is finite nowhere near the start
                if "initial parameters" not in str(error):
                    raise
                raise InputError(NOT_FINITE) from error
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

    def advance(self, state: HMCState, n: int) -> tuple[HMCState, dict[str, Array]]:
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
