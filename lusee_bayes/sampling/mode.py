"""The mode of a program's posterior and its curvature there: where to begin, in which coordinates.

The curvature is the Hessian where few sites are sampled (the sky integrated out). Where a
program predicts the data at a site CorrelatedNormal, as d ~ N(f(x), N), it is that of Gauss and
Newton, J^T N^-1 J plus that of the prior, J the derivative of f: for the sky and thousands of
other unknowns at once. At a site TimesStudentT every time has its weight in N^-1. Both only serve
as coordinates; the density sampled is the program's own.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int
from numpyro import distributions as dist
from numpyro import handlers
from numpyro.infer import init_to_median

from lusee_bayes.core.arrays import Array
from lusee_bayes.core.checks import is_traced
from lusee_bayes.core.errors import InputError
from lusee_bayes.sampling.curvature import Potential, root_of_inverse, without_held
from lusee_bayes.sampling.distributions import HALF_LOG_2PI, Prediction
from lusee_bayes.sampling.promotion import numpyro_promotion
from lusee_bayes.sampling.whitening import Whitening
from lusee_bayes.systematics.base import MOST_COLLAPSED
from lusee_bayes.systematics.chart import Chart

# the mode is found when a step is shorter than this, rms in standard deviations: near enough for
# coordinates, and longer than what rounding of a log evidence makes (1e-7, or 5e-4 of one)
SETTLED = 1e-2
MAX_STEPS = 100
# a step is halved this often at most until it leads downwards
HALVINGS = 20
# what is tried at first, in standard deviations of the prior
FIRST = 1e-3
# draws of the prior that are looked at for every further start
CANDIDATES = 12


class LaplaceApproximation(eqx.Module):
    """A Gaussian about the mode of a posterior.

    Attributes
    ----------
    whitening : Whitening
        Coordinates in which it is N(0, 1).
    log_evidence : () array
        ln p(d) of this approximation.
    moved : () array
        Length of the last step, rms in standard deviations.
    steps : () array
        How many steps were taken.
    """

    whitening: Whitening
    log_evidence: Float[Array, "..."]
    moved: Float[Array, "..."]
    steps: Int[Array, "..."]

    @property
    def converged(self) -> Bool[Array, "..."]:
        """Whether the mode was found."""
        return self.moved < SETTLED

    def require_converged(self) -> LaplaceApproximation:
        """Return itself.

        Raises
        ------
        InputError
            If the mode was not found.
        """
        if not is_traced(self.moved) and not bool(self.converged):
            raise InputError(
                f"no mode of the posterior was found in {int(self.steps)} steps (the last moved by "
                f"{float(self.moved):.2g} standard deviations); narrow the priors, or start nearer"
            )
        return self


@numpyro_promotion()
def laplace_approximation(
    program: Callable,
    arguments: Mapping[str, Any],
    start: Mapping[str, Array] | None = None,
    hold: Sequence[str] = (),
    starts: int = 1,
    chart: Chart | None = None,
) -> LaplaceApproximation:
    """Find the Gaussian about the mode of ``program(**arguments)``; JAX can trace it.

    Parameters
    ----------
    program : callable
        A NumPyro model.
    arguments : mapping
        Its arguments, with the data.
    start : mapping of array, optional
        Values of sites to begin from, by default the medians of their priors.
    hold : sequence of str
        Sites that stay there, such as the standard deviation of thousands of others: where both
        are sampled, the joint mode lies far from the bulk of the posterior.
    starts : int
        How many places to climb from: the first, and the likeliest of some draws of the prior.
        Of several modes, the one with the most weight is taken.
    chart : Chart, optional
        Coordinates in which ridges are straight.

    Returns
    -------
    LaplaceApproximation
        Check :attr:`LaplaceApproximation.converged`.

    Raises
    ------
    InputError
        If the program has too many unknowns for an exact Hessian, and no site CorrelatedNormal or
        TimesStudentT.
    """
    arguments = dict(arguments)
    trace = _trace(program, arguments, start or {})
    latent = {
        name: site
        for name, site in trace.items()
        if site["type"] == "sample" and not site["is_observed"]
    }
    unconstrained = {
        name: dist.biject_to(site["fn"].support).inv(jnp.asarray(site["value"], dtype=jnp.float64))
        for name, site in latent.items()
    }
    sites = tuple((name, value.shape) for name, value in unconstrained.items())
    n = sum(value.size for value in unconstrained.values())
    shapes = Whitening(jnp.zeros(n), jnp.zeros((n, 0)), jnp.zeros(()), sites, chart)
    first = shapes.from_values(unconstrained)
    problem = Potential(program, arguments, shapes, _predicts(trace), tuple(hold))
    if not problem.predicts and n > MOST_COLLAPSED:
        raise InputError(
            f"the program has {n} unknowns and no site CorrelatedNormal, whose curvature is found "
            f"without the Hessian; at most {MOST_COLLAPSED} unknowns are possible"
        )
    free = jnp.ones(n).at[problem.held()].set(0.0)
    scale = FIRST * _prior_scale(latent)
    if starts == 1:
        return _climb(problem, first, free, scale)
    drawn = _drawn(program, arguments, shapes, CANDIDATES * (starts - 1))
    heights = jax.lax.map(problem.value, drawn)
    best = jnp.argsort(jnp.where(jnp.isnan(heights), jnp.inf, heights))[: starts - 1]
    places = jnp.concatenate([first[None], drawn[best]])
    found = jax.lax.map(lambda x: _climb(problem, x, free, scale), places)
    weight = jnp.where(found.converged, found.log_evidence, -jnp.inf)
    return jax.tree.map(lambda leaf: leaf[jnp.argmax(weight)], found)


def _drawn(
    program: Callable, arguments: dict, shapes: Whitening, n: int
) -> Float[Array, "draws unknowns"]:
    """Coordinates of sites drawn from the prior."""

    def one(key):
        trace = handlers.trace(handlers.seed(program, key)).get_trace(**arguments)
        values = {
            name: dist.biject_to(trace[name]["fn"].support).inv(
                jnp.asarray(trace[name]["value"], dtype=jnp.float64)
            )
            for name in shapes.names
        }
        return shapes.from_values(values)

    return jax.lax.map(one, jax.random.split(jax.random.PRNGKey(1), n))


def _trace(program: Callable, arguments: dict, start: Mapping[str, Array]) -> dict:
    """One run of the program at the start."""
    median = init_to_median(num_samples=31)

    def place(site):
        return start[site["name"]] if site["name"] in start else median(site)

    model = handlers.seed(program, jax.random.PRNGKey(0))
    return handlers.trace(handlers.substitute(model, substitute_fn=place)).get_trace(**arguments)


def _prior_scale(latent: dict) -> Float[Array, " n"]:
    """Standard deviations of the priors in the unconstrained coordinates, from draws."""
    scales = []
    for name, site in latent.items():
        draws = site["fn"].sample(jax.random.PRNGKey(len(name)), (100,))
        x = jax.vmap(dist.biject_to(site["fn"].support).inv)(jnp.asarray(draws, jnp.float64))
        scales.append(x.std(0).reshape(-1))
    return jnp.concatenate(scales)


def _predicts(trace: dict) -> bool:
    observed = [s for s in trace.values() if s["type"] == "sample" and s["is_observed"]]
    return any(isinstance(site["fn"], Prediction) for site in observed)


@eqx.filter_jit
def _climb(
    problem: Potential,
    first: Float[Array, " n"],
    free: Float[Array, " n"],
    scale: Float[Array, " n"],
) -> LaplaceApproximation:
    """Newton's method with halved steps; where the curvature is negative, its absolute value.

    free : 1 where x may move, 0 where it is held
    """

    def look(x, scale):
        """White gradient at x, the coordinates' root, and whether all curvature is positive."""
        gradient, curvature = problem.gradient_and_curvature(x, scale)
        gradient = gradient * free
        curvature = without_held(curvature, free)
        root, positive = root_of_inverse(curvature, problem)
        narrow = 1.0 / jnp.sqrt(jnp.abs(jnp.diagonal(curvature)))
        return root.T @ gradient, root, positive, jnp.minimum(narrow, scale)

    def step(carry):
        x, value, white, root, _, scale, n = carry
        direction = root @ white

        def worse(inner):
            _, trial, count = inner
            return (~(trial <= value)) & (count < HALVINGS)

        def halve(inner):
            length, _, count = inner
            length = length / 2.0
            return length, problem.value(x - length * direction), count + 1

        start = (jnp.asarray(2.0), jnp.asarray(np.inf), 0)
        length, trial, _ = jax.lax.while_loop(worse, halve, start)
        better = trial <= value
        x = jnp.where(better, x - length * direction, x)
        # where no step leads downwards, the search has failed
        n = jnp.where(better, n + 1, MAX_STEPS)
        return x, jnp.where(better, trial, value), *look(x, scale), n

    def length_of(white, positive):
        moved = jnp.sqrt((white**2).mean())
        return jnp.where(positive, moved, jnp.maximum(moved, 1.0))

    def going(carry):
        _, _, white, _, positive, _, n = carry
        return (~(length_of(white, positive) < SETTLED)) & (n < MAX_STEPS)

    start = (first, problem.value(first), *look(first, scale), jnp.asarray(0))
    x, value, white, _, positive, scale, n = jax.lax.while_loop(going, step, start)
    root, _ = root_of_inverse(
        without_held(problem.gradient_and_curvature(x, scale)[1], free), problem
    )
    log_det = jnp.linalg.slogdet(root)[1]
    whitening = Whitening(x, root, log_det, problem.shapes.sites, problem.shapes.chart)
    log_evidence = -value + log_det + x.shape[0] * HALF_LOG_2PI
    return LaplaceApproximation(whitening, log_evidence, length_of(white, positive), n)
