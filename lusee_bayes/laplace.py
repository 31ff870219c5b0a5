"""The mode of a program's posterior and its curvature there: where to begin, in which coordinates.

The curvature is the Hessian where few sites are sampled (the sky integrated out). Where a
program predicts the data at a site CorrelatedNormal, as d ~ N(f(x), N), it is that of Gauss and
Newton, J^T N^-1 J plus that of the prior, J the derivative of f: for the sky and thousands of
other unknowns at once. Both only serve as coordinates; the density sampled is the program's own.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from numpyro import distributions as dist
from numpyro import handlers
from numpyro.infer import init_to_median
from numpyro.infer.util import potential_energy

from lusee_bayes.checks import InputError, is_traced
from lusee_bayes.coordinates import Chart, Whitening
from lusee_bayes.sites import HALF_LOG_2PI, CorrelatedNormal

# the mode is found when a step is shorter than this, rms in standard deviations: near enough for
# coordinates, and longer than what rounding of a log evidence makes (1e-7, or 5e-4 of one)
SETTLED = 1e-2
MAX_STEPS = 100
# a step is halved this often at most until it leads downwards
HALVINGS = 20
# step of the differences that give the Hessian, in standard deviations
DIFFERENCE = 0.1
# what is tried at first, in standard deviations of the prior
FIRST = 1e-3
# draws of the prior that are looked at for every further start
CANDIDATES = 12
# columns of the Jacobian at once: more would take more memory than time they save
COLUMNS = 64
# with more unknowns than this, the exact Hessian is out of reach
MOST_FOR_HESSIAN = 64


class Laplace(eqx.Module):
    """A Gaussian about the mode of a posterior.

    whitening : its coordinates; log_evidence : ln p(d) in its approximation;
    moved : length of the last step, rms in standard deviations; steps : how many were taken
    """

    whitening: Whitening
    log_evidence: Float[Array, "..."]
    moved: Float[Array, "..."]
    steps: Int[Array, "..."]

    @property
    def converged(self) -> Bool[Array, "..."]:
        """Whether the mode was found."""
        return self.moved < SETTLED

    def require_converged(self) -> Laplace:
        """Itself. InputError if the mode was not found."""
        if not is_traced(self.moved) and not bool(self.converged):
            raise InputError(
                f"no mode of the posterior was found in {int(self.steps)} steps (the last moved by "
                f"{float(self.moved):.2g} standard deviations); narrow the priors, or start nearer"
            )
        return self


def laplace(
    program: Callable,
    arguments: Mapping[str, Any],
    start: Mapping[str, Array] | None = None,
    hold: Sequence[str] = (),
    starts: int = 1,
    chart: Chart | None = None,
) -> Laplace:
    """The Gaussian about the mode of ``program(**arguments)``; a part of a JAX program.

    start : values of sites to begin from, by default the medians of their priors; hold : sites that
    stay there, such as the standard deviation of thousands of others: where both are sampled, the
    joint mode lies far from where the posterior is. ``starts``: how many places to climb from, the
    first and the likeliest of some draws of the prior, where there may be more than one mode; the
    one with the most weight is taken. ``chart``: coordinates in which ridges are straight. Call it
    with NumPy's dtype promotion "standard" and rank promotion allowed: NumPyro needs them.
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
    problem = _Problem(program, arguments, shapes, _predicts(trace), tuple(hold))
    if not problem.predicts and n > MOST_FOR_HESSIAN:
        raise InputError(
            f"the program has {n} unknowns and no site CorrelatedNormal, whose curvature is found "
            f"without the Hessian; at most {MOST_FOR_HESSIAN} unknowns are possible"
        )
    free = jnp.ones(n).at[problem.held()].set(0.0)
    scale = FIRST * _prior_scale(latent)
    if starts == 1:
        return _climb(problem, first, free, scale)
    drawn = _drawn(program, arguments, shapes, CANDIDATES * (starts - 1))
    heights = jax.lax.map(problem.potential, drawn)
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
    return any(isinstance(site["fn"], CorrelatedNormal) for site in observed)


class _Problem(eqx.Module):
    """Minus the log posterior of unconstrained x, and its curvature."""

    program: Callable = eqx.field(static=True)
    arguments: dict[str, Any]
    shapes: Whitening
    predicts: bool = eqx.field(static=True)
    hold: tuple[str, ...] = eqx.field(static=True)

    def held(self) -> np.ndarray:
        """Positions of what is held."""
        sites = self.shapes.sites
        parts = [np.full(int(np.prod(shape)), name in self.hold) for name, shape in sites]
        return np.flatnonzero(np.concatenate(parts))

    def values(self, x: Float[Array, " n"], still: bool) -> tuple[dict[str, Array], Array]:
        """The sites' values at x, and ln|det|; ``still``: without derivatives by what is held."""
        parts = self.shapes.split(x)
        for name in self.hold if still else ():
            if name in parts:
                parts[name] = jax.lax.stop_gradient(parts[name])
        return (
            (parts, jnp.zeros(()))
            if self.shapes.chart is None
            else self.shapes.chart.to_values(parts)
        )

    def potential(self, x: Float[Array, " n"], still: bool = False) -> Float[Array, ""]:
        values, log_det = self.values(x, still)
        return potential_energy(self.program, (), self.arguments, values) - log_det

    def residual(self, x: Float[Array, " n"], still: bool = False) -> Float[Array, " data"]:
        """L^-1 (d - f(x)) of all sites that predict."""
        values, _ = self.values(x, still)

        def place(site):
            if site["name"] in values:
                return dist.biject_to(site["fn"].support)(values[site["name"]])
            return None

        model = handlers.substitute(handlers.seed(self.program, 0), substitute_fn=place)
        parts = []
        for site in handlers.trace(model).get_trace(**self.arguments).values():
            if site["type"] == "sample" and isinstance(site["fn"], CorrelatedNormal):
                fn = site["fn"]
                parts.append(fn.factor.whiten(site["value"] - fn.loc))
        return jnp.concatenate(parts)

    def slope(self, x: Float[Array, " n"]) -> Float[Array, " n"]:
        return jax.grad(self.potential)(x)

    def gradient_and_curvature(
        self, x: Float[Array, " n"], scale: Float[Array, " n"]
    ) -> tuple[Float[Array, " n"], Float[Array, "n n"]]:
        """Of the potential at x; ``scale``: lengths over which it is a parabola."""
        if not self.predicts:
            # all in one map: second derivatives of banded factors take minutes to compile
            steps = DIFFERENCE * jnp.diag(scale)
            places = jnp.concatenate([x[None], x[None] + steps, x[None] - steps])
            gradients = jax.lax.map(self.slope, places)
            up, down = jnp.split(gradients[1:], 2)
            slopes = (up - down) / (2.0 * DIFFERENCE * scale[:, None])
            return gradients[0], 0.5 * (slopes + slopes.T)

        def prior(x, still=False):
            return self.potential(x, still) - 0.5 * (self.residual(x, still) ** 2).sum()

        columns = self._derivatives(self.residual, x)
        if self.shapes.chart is None:
            # every site's prior is a product over its values
            _, diagonal = jax.jvp(jax.grad(prior), (x,), (jnp.ones_like(x),))
            return self.slope(x), columns @ columns.T + jnp.diag(jnp.abs(diagonal))
        of_prior = self._derivatives(jax.grad(prior), x)
        return self.slope(x), columns @ columns.T + 0.5 * (of_prior + of_prior.T)

    def _derivatives(
        self, f: Callable[..., Float[Array, " m"]], x: Float[Array, " n"]
    ) -> Float[Array, "n m"]:
        """The transposed Jacobian of f(x, still).

        Apart for what is held: charts need matrices that only scales change, and products of
        those with every other direction would take longer than all the rest.
        """
        held = self.held()
        unit = jnp.eye(x.shape[0])
        _, derivative = jax.linearize(lambda x: f(x, True), x)
        rows = jax.lax.map(derivative, unit, batch_size=COLUMNS)
        if not len(held):
            return rows
        return rows.at[held].set(
            jax.lax.map(lambda e: jax.jvp(lambda x: f(x, False), (x,), (e,))[1], unit[held])
        )


def _apart(curvature: Float[Array, "n n"], free: Float[Array, " n"]) -> Float[Array, "n n"]:
    """What is held has nothing but a curvature of its own: its true one may not be positive."""
    held = (1.0 - free) * jnp.abs(jnp.diagonal(curvature))
    return curvature * free[:, None] * free[None] + jnp.diag(held)


def _factor(curvature: Float[Array, "n n"], problem: _Problem) -> tuple[Array, Array]:
    """(R, whether all curvature is positive), R R^T the inverse of its absolute value."""
    if not problem.predicts:
        return _of_any_sign(curvature)
    lower = jnp.linalg.cholesky(curvature)
    unit = jnp.eye(curvature.shape[0])
    root = jax.scipy.linalg.solve_triangular(lower, unit, lower=True).T
    if problem.shapes.chart is None:
        return root, jnp.asarray(True)
    # a prior in curved coordinates need not curve upwards everywhere
    positive = jnp.isfinite(root).all()
    return jax.lax.cond(positive, lambda: (root, positive), lambda: _of_any_sign(curvature))


def _of_any_sign(curvature: Float[Array, "n n"]) -> tuple[Array, Array]:
    # in units of its own diagonal, since parameters come in any
    scale = 1.0 / jnp.sqrt(jnp.abs(jnp.diagonal(curvature)))
    values, vectors = jnp.linalg.eigh(curvature * scale[:, None] * scale[None])
    least = np.finfo(np.float64).eps * jnp.abs(values).max()
    strength = jnp.maximum(jnp.abs(values), least)
    return scale[:, None] * vectors / jnp.sqrt(strength)[None], (values > 0).all()


@eqx.filter_jit
def _climb(
    problem: _Problem,
    first: Float[Array, " n"],
    free: Float[Array, " n"],
    scale: Float[Array, " n"],
) -> Laplace:
    """Newton's method with halved steps; where the curvature is negative, its absolute value.

    free : 1 where x may move, 0 where it is held
    """

    def look(x, scale):
        """White gradient at x, the coordinates' root, and whether all curvature is positive."""
        gradient, curvature = problem.gradient_and_curvature(x, scale)
        gradient = gradient * free
        curvature = _apart(curvature, free)
        root, positive = _factor(curvature, problem)
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
            return length, problem.potential(x - length * direction), count + 1

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

    start = (first, problem.potential(first), *look(first, scale), jnp.asarray(0))
    x, value, white, _, positive, scale, n = jax.lax.while_loop(going, step, start)
    root, _ = _factor(_apart(problem.gradient_and_curvature(x, scale)[1], free), problem)
    log_det = jnp.linalg.slogdet(root)[1]
    whitening = Whitening(x, root, log_det, problem.shapes.sites, problem.shapes.chart)
    log_evidence = -value + log_det + x.shape[0] * HALF_LOG_2PI
    return Laplace(whitening, log_evidence, length_of(white, positive), n)
