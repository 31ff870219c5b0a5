"""Hamiltonian Monte Carlo for any NumPyro program: parallel chains that survive a kill.

Programs are sampled in coordinates in which their posterior is nearly round, if these are known
from the sky's analytic posterior or from :mod:`lusee_bayes.sampling.mode`:
``whitened(program, whitening)`` samples m through z, m = mean + R z. The coordinates change the
speed of sampling, not the program's density.

Draws are saved while sampling: a run that is killed at any moment can be resumed. Each chunk has
one file, with its draws and the state of the chains after it, written completely or not at all. A
run resumes from the last file; nothing else needs to be consistent with it.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import zip_longest
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Float, PRNGKeyArray
from numpyro.infer import HMC, MCMC, NUTS
from numpyro.infer.hmc import HMCState
from numpyro.infer.hmc_util import HMCAdaptState
from numpyro.infer.mcmc import MCMCKernel
from numpyro.infer.util import constrain_fn

from lusee_bayes.core import checks, files
from lusee_bayes.core.arrays import Array
from lusee_bayes.core.errors import InputError, require_known
from lusee_bayes.core.lazy import dist, numpyro
from lusee_bayes.core.reading import read_model, reading
from lusee_bayes.linear.linear_gaussian import LinearGaussian
from lusee_bayes.linear.posterior import Posterior
from lusee_bayes.sampling import distributions, programs
from lusee_bayes.systematics.systematic import SKY, Chart

# statistics of every draw by their ArviZ names, and NumPyro's names ("lp" is minus its potential)
STATISTICS = {
    "lp": "potential_energy",
    "energy": "energy",
    "diverging": "diverging",
    "acceptance_rate": "accept_prob",
    "step_size": "adapt_state.step_size",
    "n_steps": "num_steps",
}


@dataclass(frozen=True)
class Chains:
    """Draws, and statistics of every draw.

    Attributes
    ----------
    sites : dict of (chains, draws, ...) arrays
        Draws by site.
    statistics : dict of (chains, draws) arrays
        By the names of ``STATISTICS``.
    """

    sites: dict[str, np.ndarray]
    statistics: dict[str, np.ndarray]

    @property
    def gradients(self) -> int:
        """Number of evaluations of density and gradient in all chains, without warmup.

        For "crank-nicolson", evaluations of the density only.
        """
        return int(self.statistics["n_steps"].sum())


class Whitening(eqx.Module):
    """Coordinates z of one or more sites, x = mean + R z, in which a posterior is round.

    x contains the sites' unconstrained values (numpyro's ``biject_to``), one site after the other;
    with a chart, its coordinates for them.

    Attributes
    ----------
    mean : (unknowns,) array
        x at z = 0.
    root : (unknowns, white) array
        R, where R R^T is the covariance of x.
    log_det : () array
        ln|det R|.
    sites : tuple of (str, tuple of int)
        Name and unconstrained shape of each site.
    chart : Chart, optional
        Coordinates in which ridges are straight.

    Raises
    ------
    InputError
        If the sites and the mean have different numbers of values.
    """

    mean: Float[Array, " unknowns"]
    root: Float[Array, "unknowns white"]
    log_det: Float[Array, ""]
    sites: tuple[tuple[str, tuple[int, ...]], ...] = eqx.field(static=True)
    chart: Chart | None = None

    def __check_init__(self):
        n = sum(math.prod(shape) for _, shape in self.sites)
        if not checks.is_traced(self.mean) and self.mean.shape != (n,):
            raise InputError(f"the sites have {n} values, the mean {self.mean.shape[0]}")

    @classmethod
    def of(cls, posterior: Posterior, site: str = "sky") -> Whitening:
        """Return the coordinates in which a posterior of the sky is N(0, 1).

        Parameters
        ----------
        posterior : Posterior
            The analytic posterior.
        site : str
            Name of the sky's site.

        Raises
        ------
        InputError
            If the sky's prior has no density.
        """
        log_det = posterior.prior.log_det() - jnp.log(jnp.diagonal(posterior.lower)).sum()
        root = posterior.root()
        return cls(posterior.mean, root, log_det, ((site, (root.shape[0],)),))

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the sites."""
        return tuple(name for name, _ in self.sites)

    def to_values(
        self, x: Float[Array, " unknowns"], hold: Sequence[str] = ()
    ) -> tuple[dict[str, Float[Array, "..."]], Float[Array, ""]]:
        """Compute the sites' unconstrained values at x, and ln|det| of their derivative by x.

        The sites ``hold`` have no derivatives.
        """
        ends = np.cumsum([math.prod(shape) for _, shape in self.sites])
        parts = zip(self.sites, jnp.split(x, ends[:-1]), strict=True)
        values = {name: part.reshape(shape) for (name, shape), part in parts}
        values |= {n: jax.lax.stop_gradient(values[n]) for n in hold if n in values}
        return (values, jnp.zeros(())) if self.chart is None else self.chart.to_values(values)

    def from_values(self, values: Mapping[str, Float[Array, "..."]]) -> Float[Array, " unknowns"]:
        """Compute x from the sites' unconstrained values."""
        values = values if self.chart is None else self.chart.from_values(values)
        return jnp.concatenate([values[name].reshape(-1) for name in self.names])


def whitened(program: Callable, whitening: Whitening) -> Callable:
    """Return a program that samples sites through z, x = mean + R z.

    The density is still the program's: its prior at x, times ``|det R|``. A Gaussian only sets the
    coordinates; if it differs from the posterior, sampling is slower but not wrong.

    Parameters
    ----------
    program : callable
        A NumPyro model.
    whitening : Whitening
        Coordinates of some of its latent sites.

    Returns
    -------
    callable
        The model with an improper site z, called NAME_white after the first site. It needs a value
        for z: to sample from the prior, use ``program``.

    Raises
    ------
    InputError
        When the model runs, if one of the sites is observed.
    """

    def model(*args, **kwargs):
        first = whitening.names[0]
        free = dist.ImproperUniform(dist.constraints.real_vector, (), (whitening.root.shape[1],))
        z = numpyro.sample(f"{first}{programs.WHITE_SUFFIX}", free)
        values, log_det = whitening.to_values(whitening.mean + whitening.root @ z)
        # the determinant of all coordinates is included once, with the first site
        log_dets = dict.fromkeys(whitening.names, 0.0) | {first: whitening.log_det + log_det}
        config = {name: _given(values[name], log_dets[name]) for name in whitening.names}
        with numpyro.handlers.reparam(config=config):
            return program(*args, **kwargs)

    return model


def _given(value: Float[Array, "..."], log_det: float | Float[Array, ""]) -> Callable:
    """Reparametrise a site: its given unconstrained value is fixed, its density is a factor.

    ``log_det`` of the coordinates behind the value is added to the density.
    """

    def reparametrised(name, fn, obs):
        if obs is not None:
            raise InputError(f"the site '{name}' is observed; only latent sites can be whitened")
        transform = dist.biject_to(fn.support)
        site = transform(value)
        each = fn.log_prob(site)  # in a plate, one of every element: a scalar would be repeated
        more = log_det + transform.log_abs_det_jacobian(value, site).sum()
        numpyro.factor(f"{name}_density", each + more / each.size)
        return None, site

    return reparametrised


WHAT = "the description of an unfinished run (delete its folder to start again)"
IDENTITY = "run.json"
CHUNK_GLOB = "chunk-*.npz"
CHECKPOINT = "a checkpoint (delete it to continue from the one before)"


@dataclass(frozen=True)
class Chunk:
    """The content of one file.

    Attributes
    ----------
    iteration : int
        Iterations done at its end, warmup included.
    state : list of array
        Leaves of the sampler's state there.
    draws : dict of (draws, chains, ...) array
        Draws of the chunk by name; empty in warmup.
    """

    iteration: int
    state: list[np.ndarray]
    draws: dict[str, np.ndarray]

    @classmethod
    def read(cls, path: Path) -> Chunk:
        """Read a chunk's file. InputError if it cannot be read."""
        kinds: dict[str, dict[str, np.ndarray]] = {"state": {}, "draws": {}}
        with reading(path, CHECKPOINT), path.open("rb") as file, np.load(file) as arrays:
            for key in sorted(arrays.files):
                kind, name = key.split(":", 1)
                kinds[kind][name] = arrays[key]
        return cls(_iteration(path), list(kinds["state"].values()), kinds["draws"])


class Checkpoints:
    """The chunks of one run in one folder.

    Parameters
    ----------
    folder : str or Path
        The folder.
    identity : dict
        JSON values that identify the run.
    resume : bool
        Whether to continue an unfinished run.

    Raises
    ------
    InputError
        If the folder has an unfinished run and ``resume`` is False, or another run, or draws of an
        unknown one.
    """

    def __init__(self, folder: str | Path, identity: dict[str, object], *, resume: bool):
        self.folder = Path(folder)
        described = json.loads(json.dumps(identity))
        marker, paths = self.folder / IDENTITY, self._paths()
        if not paths:
            with files.replacing(marker) as scratch:
                scratch.write_text(json.dumps(described, indent=2) + "\n", encoding="utf-8")
            return
        if not marker.exists():
            raise InputError(
                f"'{self.folder}' contains draws, but no {IDENTITY} of their run; delete the folder"
            )
        if not resume:
            raise InputError(
                f"'{self.folder}' contains an unfinished run ({_iteration(paths[-1])} iterations "
                "done); continue with --resume, or delete the folder"
            )
        saved = read_model(marker, dict, WHAT)
        # another scenario simulates other data: it is named first
        for name in sorted({*saved, *described}, key=lambda name: (name != "scenario", name)):
            before, now = (str(one.get(name)).splitlines() for one in (saved, described))
            for was, line in zip_longest(before, now, fillvalue="nothing"):
                if was != line:
                    raise InputError(
                        f"the unfinished run in '{self.folder}' has another {name}: "
                        f"{was.strip():.60}, now {line.strip():.60}; use it, or delete the folder"
                    )

    def _paths(self) -> list[Path]:
        return sorted(self.folder.glob(CHUNK_GLOB))

    def chunks(self) -> list[Chunk]:
        """Read all chunks so far.

        Raises
        ------
        InputError
            If one cannot be read, or is missing before the last.
        """
        chunks, done = [Chunk.read(path) for path in self._paths()], 0
        for chunk in chunks:
            start = chunk.iteration - max(map(len, chunk.draws.values()), default=0)
            if chunk.draws and start != done:
                raise InputError(
                    f"'{self.folder}' lacks the draws of iterations {done} to {start}; "
                    "delete the later chunks to continue from there"
                )
            done = chunk.iteration
        return chunks

    def append(self, chunk: Chunk) -> None:
        """Write the next chunk's file completely or not at all."""
        arrays = {f"state:{i:03d}": leaf for i, leaf in enumerate(chunk.state)}
        arrays |= {f"draws:{name}": values for name, values in chunk.draws.items()}
        path = self.folder / f"chunk-{chunk.iteration:08d}.npz"
        with files.replacing(path) as scratch, scratch.open("wb") as file:
            np.savez(file, **arrays)
            file.flush()
            os.fsync(file.fileno())


def _iteration(path: Path) -> int:
    return int(path.stem.removeprefix("chunk-"))


ALGORITHMS = ("nuts", "hmc", "crank-nicolson")

# iterations between two files: a few seconds of work at the fiducial size
CHUNK = 25

# deepest tree of NUTS where all coordinates are white
WHITE_DEPTH = 6


class CrankNicolson(MCMCKernel):
    """Rotations of white coordinates, for a posterior near N(0, 1) with an expensive gradient.

    The proposal ::

        z' = z cos a + p sin a,    p ~ N(0, 1),

    is the end of a Hamiltonian trajectory in the potential z^2 / 2. Accepting it with probability
    min(1, w(z') / w(z)), w = p(z | d) / N(z; 0, 1), gives draws from p(z | d) (preconditioned
    Crank-Nicolson; Cotter et al. 2013, Statistical Science 28, 424). After a quarter turn, z' does
    not depend on z. Warmup makes turns shorter if the acceptance rate is below its target. Skies
    that the program integrates out and returns are drawn with every z.

    Parameters
    ----------
    model : callable
        The NumPyro model.
    site : str
        Its only latent site, unconstrained.
    size : int
        Size of that site.
    turn, target : float
        Longest a, and the target of the acceptance rate.
    """

    sample_field = "z"

    def __init__(self, model: Callable, site: str, size: int, turn: float, target: float):
        self.model, self.site, self.size, self.turn, self.target = model, site, size, turn, target

    def _looked(
        self, args: tuple, kwargs: dict, z: Array, key: PRNGKeyArray
    ) -> tuple[Float[Array, ""], dict[str, Array]]:
        """-ln p at z; and z with draws of the skies that the program integrates out."""
        given = numpyro.handlers.substitute(numpyro.handlers.seed(self.model, key), {self.site: z})
        with numpyro.handlers.trace() as sites:
            returned = given(*args, **kwargs)
        to_draw = jax.tree.leaves(returned, is_leaf=lambda x: isinstance(x, LinearGaussian))
        total, drawn = jnp.zeros(()), {self.site: z}
        for name, site in sites.items():
            if site["type"] != "sample":
                continue
            fn, value = site["fn"], site["value"]
            if isinstance(fn, distributions.Marginal) and any(fn.model is one for one in to_draw):
                posterior = fn.model.condition(value).posterior
                key, subkey = jax.random.split(key)
                drawn[name.removesuffix(programs.DATA) + SKY] = posterior.sample(subkey)
                density = posterior.log_evidence
            else:
                density = fn.log_prob(value).sum()
            scale = site.get("scale")
            total = total - (density if scale is None else scale * density)
        return jnp.where(jnp.isnan(total), jnp.inf, total), drawn

    def init(self, rng_key, num_warmup, init_params, model_args, model_kwargs):
        """The first state of a chain: a sample from N(0, 1)."""
        self.warmup = num_warmup
        key, of_start, of_skies = jax.random.split(rng_key, 3)
        start, zero = jax.random.normal(of_start, (self.size,)), jnp.zeros(())
        potential, z = self._looked(model_args, model_kwargs, start, of_skies)
        adapt = HMCAdaptState(zero + self.turn, *[None] * (len(HMCAdaptState._fields) - 1))
        fields = dict.fromkeys(HMCState._fields) | {"diverging": jnp.asarray(False)}
        fields |= {"i": jnp.asarray(0), "z": z, "num_steps": jnp.asarray(1), "rng_key": key}
        fields |= {"potential_energy": potential, "energy": potential, "adapt_state": adapt}
        return HMCState(**fields | {"accept_prob": zero, "mean_accept_prob": zero})

    def sample(self, state, model_args, model_kwargs):
        """The next state of a chain."""
        key, of_turn, of_skies, of_choice = jax.random.split(state.rng_key, 4)
        z, turn = state.z[self.site], state.adapt_state.step_size
        p = jax.random.normal(of_turn, z.shape)
        proposal = z * jnp.cos(turn) + p * jnp.sin(turn)
        potential, new = self._looked(model_args, model_kwargs, proposal, of_skies)
        gained = state.potential_energy - potential + (proposal @ proposal - z @ z) / 2.0
        accept = jnp.exp(jnp.minimum(gained, 0.0))
        taken, i = jax.random.uniform(of_choice) < accept, state.i + 1
        in_warmup = i <= self.warmup
        longer = jnp.minimum(turn * jnp.exp((accept - self.target) / jnp.sqrt(i)), self.turn)
        n = jnp.where(in_warmup, i, i - self.warmup)
        return state._replace(
            i=i,
            z=jax.tree.map(lambda new, old: jnp.where(taken, new, old), new, state.z),
            potential_energy=jnp.where(taken, potential, state.potential_energy),
            energy=state.potential_energy + (p @ p) / 2.0,
            accept_prob=accept,
            mean_accept_prob=state.mean_accept_prob + (accept - state.mean_accept_prob) / n,
            diverging=jnp.isinf(potential),
            adapt_state=state.adapt_state._replace(step_size=jnp.where(in_warmup, longer, turn)),
            rng_key=key,
        )

    def postprocess_fn(self, model_args, model_kwargs):
        """A function that returns all sites of a draw, and its skies."""
        given = self.model, model_args, model_kwargs

        def sites(z: dict[str, Array]) -> dict[str, Array]:
            return z | constrain_fn(*given, {self.site: z[self.site]}, return_deterministic=True)

        return sites


@dataclass(frozen=True)
class Sampler:
    """Settings of sampling.

    If all sites are white, the metric is known; otherwise warmup learns a diagonal one.

    Attributes
    ----------
    chains : int
        Number of chains.
    warmup : int
        Iterations of each chain that adapt the step size, and are discarded.
    draws : int
        Number of draws of each chain.
    seed : int
        Seed of all chains.
    algorithm : str or None
        "nuts"; "hmc" with trajectories of a fixed length; or "crank-nicolson", without gradients,
        for a posterior with a close approximation. The default is the last if all sampled unknowns
        are linear or inferred in rounds, else "nuts".
    target_accept : float
        Target of the acceptance rate for the step size.
    trajectory : float
        Length of a trajectory of "hmc", longest of "crank-nicolson"; pi / 2 makes draws of a
        whitened Gaussian nearly independent.

    Raises
    ------
    InputError
        If a setting lies outside its range.
    """

    chains: int = 4
    warmup: int = 150
    draws: int = 1000
    seed: int = 0
    algorithm: str | None = None
    target_accept: float = 0.7
    trajectory: float = np.pi / 2

    def __post_init__(self):
        for name, least in [("chains", 1), ("warmup", 20), ("draws", 1)]:
            if getattr(self, name) < least:
                raise InputError(f"{name} must be at least {least}, got {getattr(self, name)}")
        if not 0 < self.target_accept < 1:
            raise InputError(f"target_accept must lie in 0..1, got {self.target_accept}")
        checks.require_positive("trajectory", self.trajectory)
        require_known("unknown algorithm", self.algorithm or ALGORITHMS[0], ALGORITHMS)

    def identity(self) -> dict[str, object]:
        """Return all settings except the number of draws: a resumed run must have the same."""
        return {name: value for name, value in asdict(self).items() if name != "draws"}

    def kernel(self, model: Callable, white: Whitening | None) -> HMC | CrankNicolson:
        """Make the NumPyro kernel of these settings.

        In white coordinates the metric is known, and the step size is near 1.5 n^-1/4. A trajectory
        need not exceed half a period, pi / step: 2^6 - 1 steps are enough.

        Parameters
        ----------
        model : callable
            The NumPyro model.
        white : Whitening or None
            The coordinates if all are white, else None.

        Raises
        ------
        InputError
            For "crank-nicolson" unless all coordinates are white.

        References
        ----------
        Beskos et al. 2013, Bernoulli 19, 1501 (the step size).
        """
        settings: dict[str, Any] = {"target_accept_prob": self.target_accept}
        n_white = None if white is None else white.root.shape[1]
        if self.algorithm == "crank-nicolson":
            if white is None:
                raise InputError(
                    "crank-nicolson found no coordinates in which sites are near N(0, 1); use nuts"
                )
            site = white.names[0] + programs.WHITE_SUFFIX
            return CrankNicolson(model, site, n_white, self.trajectory, self.target_accept)
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

    Several JAX devices share the chains equally, if their number allows it.

    Parameters
    ----------
    program : callable
        A NumPyro model.
    arguments : mapping
        Its arguments, with the data.
    sampler : Sampler
        Settings.
    whitening : Whitening, optional
        Coordinates of some of its sites.
    checkpoints : Checkpoints, optional
        Saves draws. Draws saved earlier are read instead of repeated; the result is the same.
    report : callable
        Called with iteration and state after each chunk.

    Raises
    ------
    InputError
        If ``whitening`` has a site that the program does not sample.
    """
    run = _Run(program, dict(arguments), sampler, whitening)
    chunks = [] if checkpoints is None else checkpoints.chunks()
    done, total, white = 0, sampler.warmup + sampler.draws, programs.WHITE_SUFFIX
    with programs.numpyro_promotion():
        state = run.start()
        if not bool(jnp.isfinite(state.potential_energy).all()):
            raise InputError(
                "the density is NaN or infinite where the chains start; check for logarithms and "
                "roots of negative numbers, scales of zero, and data outside a support"
            )
        if chunks:
            done, leaves = chunks[-1].iteration, chunks[-1].state
            state = run.shared_out(jax.tree.unflatten(jax.tree.structure(state), leaves))
        while done < total:
            state, rows = run.advance(state, run.dynamic)
            done += CHUNK
            keep = [name for name in rows if done > sampler.warmup and not name.endswith(white)]
            draws = {name: np.swapaxes(jax.device_get(rows[name]), 0, 1) for name in keep}
            chunks.append(Chunk(done, jax.device_get(jax.tree.leaves(state)), draws))
            if checkpoints is not None:
                checkpoints.append(chunks[-1])
            report(min(done, total), state)
    drawn = [chunk for chunk in chunks if chunk.draws]
    # the first chunk with draws may begin in warmup
    first = max(0, sampler.warmup - drawn[0].iteration + len(drawn[0].draws["lp"]))
    kept = slice(first, first + sampler.draws)
    # in one order of memory, so that sums are the same after a resumed run
    merged = {
        name: np.concatenate([one.draws[name] for one in drawn]).swapaxes(0, 1)[:, kept].copy("C")
        for name in drawn[0].draws
    }
    return Chains(statistics={name: merged.pop(name) for name in STATISTICS}, sites=merged)


class _Run:
    """A kernel with its model's arguments; its chunks of iterations are compiled once."""

    def __init__(
        self, program: Callable, arguments: dict, sampler: Sampler, whitening: Whitening | None
    ):
        def model(whitening, arguments):
            return (program if whitening is None else whitened(program, whitening))(**arguments)

        latent = programs.latent_sites(program, arguments)
        white = set() if whitening is None else set(whitening.names)
        if unknown := white - set(latent):
            wrong = f"the program has no latent site '{min(unknown)}'; it has {', '.join(latent)}"
            raise InputError(wrong)
        self.sampler = sampler
        # arrays in the model's arguments are traced, everything else is static
        self.dynamic, static = eqx.partition((whitening, arguments), eqx.is_array)
        all_white = whitening if set(latent) == white else None
        self.kernel = sampler.kernel(lambda given: model(*eqx.combine(given, static)), all_white)
        # with few cores, XLA may hang in factorising batches of matrices; several devices, with one
        # chain each, would only stand idle
        chart = None if whitening is None else whitening.chart
        factorises = not programs.predicts(program, arguments) or bool(chart and chart.factorises)
        self.one_by_one = len(jax.local_devices()) == 1 and factorises
        self.advance = jax.jit(self._advance)

    def _of_chains(self, function: Callable[[Any], Any], chains: Any) -> Any:
        """Apply a function of one chain to all of them."""
        return jax.lax.map(function, chains) if self.one_by_one else jax.vmap(function)(chains)

    def start(self) -> HMCState:
        """The first state of every chain."""

        def first(keys, dynamic):
            given = self.sampler.warmup, None, (dynamic,), {}
            return self._of_chains(lambda key: self.kernel.init(key, *given), keys)

        keys = jax.random.split(jax.random.PRNGKey(self.sampler.seed), self.sampler.chains)
        return self.shared_out(jax.jit(first)(keys, self.dynamic))

    def _advance(self, state: HMCState, dynamic) -> tuple[HMCState, dict[str, Array]]:
        """Run ``CHUNK`` iterations: return the state after them, and (chains, CHUNK, ...) rows."""

        lengths = {"num_warmup": self.sampler.warmup, "num_samples": CHUNK}

        def chain(state):
            mcmc = MCMC(self.kernel, progress_bar=False, **lengths)
            mcmc.post_warmup_state = state  # the kernel counts iterations: warmup is in pieces, too
            mcmc.run(state.rng_key, dynamic, extra_fields=tuple(STATISTICS.values()))
            fields = mcmc.get_extra_fields()
            rows = {name: fields[field] for name, field in STATISTICS.items()}
            return mcmc.last_state, mcmc.get_samples() | rows | {"lp": -rows["lp"]}

        return self._of_chains(chain, state)

    def shared_out(self, state: HMCState) -> HMCState:
        """Share the chains equally among devices, if their number allows it."""
        devices = jax.local_devices()
        if len(devices) == 1 or self.sampler.chains % len(devices):
            return state
        mesh = Mesh(np.asarray(devices), ("chain",))
        return jax.device_put(state, NamedSharding(mesh, PartitionSpec("chain")))
