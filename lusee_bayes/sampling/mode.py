"""The mode of a program, the curvature there, its evidence, and the uncertainty of quantities.

Mode and curvature give the start and the coordinates of sampling. The curvature is the Hessian if
few sites are sampled (the sky integrated out). If a program predicts the data at a site
CorrelatedNormal, as d ~ N(f(x), N), the curvature is that of Gauss and Newton, J^T N^-1 J plus the
prior's, J the derivative of f: it handles the sky and thousands of other unknowns at once. At a
site TimesStudentT, N^-1 includes a weight for every time. Mode and curvature only set coordinates;
the density sampled is the program's own.

Evidences compare how well programs fit the data. They are estimated, with errors, by importance
sampling from a Student t about the mode.

Draws of the sky give maps of standard deviations and intervals, and statistics of chosen
quantities. Skies are draws (chains, draws, modes) of Galactic harmonic coefficients in K, from HMC
or :meth:`Posterior.sample`; maps are HEALPix RING, Galactic, in K.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import arviz_base
import arviz_stats
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
from jaxtyping import Bool, Float, Int
from numpyro import distributions as dist
from numpyro import handlers, infer
from numpyro.infer.util import constrain_fn, potential_energy

from lusee_bayes.core.arrays import Array, DataVector
from lusee_bayes.core.errors import InputError
from lusee_bayes.core.harmonics import harmonics_at, lmax_of, pixel_matrix, power_spectrum
from lusee_bayes.sampling.distributions import HALF_LOG_2PI, Prediction
from lusee_bayes.sampling.hmc import Whitening, whitened
from lusee_bayes.sampling.programs import DATA, WHITE_SUFFIX, Program, latent_of, numpyro_promotion
from lusee_bayes.systematics.systematic import MOST_COLLAPSED, Chart

# recurring types of arrays
Coordinates = Float[Array, " n"]
Matrix = Float[Array, "n n"]
Skies = Float[np.ndarray, "chains draws modes"]
Quantity = Float[np.ndarray, "chains draws"]

# step of the differences that give the Hessian, in standard deviations
DIFFERENCE = 0.1
# columns of the Jacobian at once: more would cost memory and save little time
COLUMNS = 64


class Potential(eqx.Module):
    """Minus the log posterior as a function of a program's unconstrained coordinates x.

    Attributes
    ----------
    program : callable
        A NumPyro model.
    arguments : dict
        Its arguments, with the data.
    shapes : Whitening
        Names and shapes of the sites in x, and the chart of their coordinates.
    predicts : bool
        Whether the program predicts the data, at sites CorrelatedNormal or TimesStudentT.
    hold : tuple of str
        Fixed sites.
    """

    program: Callable = eqx.field(static=True)
    arguments: dict[str, Any]
    shapes: Whitening
    predicts: bool = eqx.field(static=True)
    hold: tuple[str, ...] = eqx.field(static=True)

    def held(self) -> np.ndarray:
        """Return the positions of fixed sites in x."""
        sites = self.shapes.sites
        parts = [np.full(int(np.prod(shape)), name in self.hold) for name, shape in sites]
        return np.flatnonzero(np.concatenate(parts))

    def value(self, x: Coordinates, still: bool = False) -> Float[Array, ""]:
        """Return the potential at x; ``still``: without derivatives by fixed sites."""
        values, log_det = self.shapes.to_values(x, self.hold if still else ())
        return potential_energy(self.program, (), self.arguments, values) - log_det

    def residual(self, x: Coordinates, still: bool = False) -> Float[Array, " data"]:
        """Return the residuals of all predicting sites, e.g. L^-1 (d - f(x)), N = L L^T."""
        return jnp.concatenate([fn.residual(value) for fn, value in self._predictions(x, still)])

    def misfit(self, x: Coordinates, still: bool = False) -> Float[Array, ""]:
        """Return the misfit of all predicting sites, e.g. chi^2 / 2."""
        return sum((fn.misfit(value) for fn, value in self._predictions(x, still)), jnp.zeros(()))

    def _predictions(self, x: Coordinates, still: bool) -> list[tuple[Prediction, Array]]:
        values, _ = self.shapes.to_values(x, self.hold if still else ())
        program = handlers.seed(self.program, 0)
        model = handlers.substitute(program, constrain_fn(program, (), self.arguments, values))
        return [
            (site["fn"], site["value"])
            for site in handlers.trace(model).get_trace(**self.arguments).values()
            if site["type"] == "sample" and isinstance(site["fn"], Prediction)
        ]

    def gradient_and_curvature(self, x: Coordinates, scale: Coordinates) -> tuple[Array, Array]:
        """Return both at x; ``scale``: lengths over which the potential is a parabola.

        The curvature is that of Gauss and Newton if the program predicts the data, else the
        Hessian from differences of gradients.
        """
        slope = jax.grad(self.value)
        if not self.predicts:
            # one map of gradients: second derivatives of banded factors take minutes to compile
            steps = DIFFERENCE * jnp.diag(scale)
            places = jnp.concatenate([x[None], x[None] + steps, x[None] - steps])
            gradients = jax.lax.map(slope, places)
            up, down = jnp.split(gradients[1:], 2)
            slopes = (up - down) / (2.0 * DIFFERENCE * scale[:, None])
            return gradients[0], 0.5 * (slopes + slopes.T)

        def prior(x, still=False):
            return self.value(x, still) - self.misfit(x, still)

        columns = self._derivatives(self.residual, x)
        of_prior = self._derivatives(jax.grad(prior), x)
        return slope(x), columns @ columns.T + 0.5 * (of_prior + of_prior.T)

    def _derivatives(self, f: Callable[..., Array], x: Coordinates) -> Float[Array, "n m"]:
        """The transposed Jacobian of f(x, still).

        Fixed sites are differentiated separately: a chart's matrices depend only on scales, and
        their products with every other direction would take longer than everything else.
        """
        held, unit = self.held(), jnp.eye(x.shape[0])
        _, derivative = jax.linearize(lambda x: f(x, True), x)
        rows = jax.lax.map(derivative, unit, batch_size=COLUMNS)
        if not len(held):
            return rows
        exact = jax.lax.map(lambda e: jax.jvp(lambda x: f(x, False), (x,), (e,))[1], unit[held])
        return rows.at[held].set(exact)


def root_of_inverse(curvature: Matrix, problem: Potential) -> tuple[Array, Array]:
    """Return R, where R R^T inverts the absolute curvature, and whether all of it is positive."""
    if not problem.predicts:
        return _root_of_any_sign(curvature)
    lower = jnp.linalg.cholesky(curvature)
    root = jax.scipy.linalg.solve_triangular(lower, jnp.eye(len(lower)), lower=True).T
    # the curvature of a prior need not be positive everywhere
    positive = jnp.isfinite(root).all()
    return jax.lax.cond(positive, lambda: (root, positive), lambda: _root_of_any_sign(curvature))


def _root_of_any_sign(curvature: Matrix) -> tuple[Array, Array]:
    # in units of its diagonal, because parameters have any units
    scale = 1.0 / jnp.sqrt(jnp.abs(jnp.diagonal(curvature)))
    values, vectors = jnp.linalg.eigh(curvature * scale[:, None] * scale[None])
    strength = jnp.maximum(jnp.abs(values), np.finfo(np.float64).eps * jnp.abs(values).max())
    return scale[:, None] * vectors / jnp.sqrt(strength)[None], (values > 0).all()


# the search ends when a step is shorter than this, rms in standard deviations: near enough for
# coordinates, and longer than steps from rounding of a log evidence (1e-7, or 5e-4 of one)
SETTLED = 1e-2
MAX_STEPS = 100
# most halvings of a step until it leads downwards
HALVINGS = 20
# first scale for differences, in standard deviations of the prior
FIRST = 1e-3
# samples from the prior for every start: they give its widths, and are compared for further starts
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
        Number of steps.
    """

    whitening: Whitening
    log_evidence: Float[Array, "..."]
    moved: Float[Array, "..."]
    steps: Int[Array, "..."]

    @property
    def converged(self) -> Bool[Array, "..."]:
        """Whether the search reached the mode."""
        return self.moved < SETTLED


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
        Start values of sites, by default the medians of their priors.
    hold : sequence of str
        Sites fixed at the start, such as the standard deviation of thousands of others: if both
        are sampled, the joint mode lies far from the bulk of the posterior.
    starts : int
        Number of starting points: ``start``, and the most probable of some samples from the prior.
        Of several modes, the one with the highest evidence is returned.
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
    unconstrained = {name: _unconstrained(trace[name]) for name in latent_of(trace)}
    sites = tuple((name, value.shape) for name, value in unconstrained.items())
    n = sum(value.size for value in unconstrained.values())
    shapes = Whitening(jnp.zeros(n), jnp.zeros((n, 0)), jnp.zeros(()), sites, chart)
    first = shapes.from_values(unconstrained)
    predicts = any(isinstance(s.get("fn"), Prediction) and s["is_observed"] for s in trace.values())
    problem = Potential(program, arguments, shapes, predicts, tuple(hold))
    observed = sum(s["type"] == "sample" and s["is_observed"] for s in trace.values())
    if not problem.predicts and n > (most := MOST_COLLAPSED * observed):
        raise InputError(
            f"the program has {n} unknowns, expected at most {most} without a site "
            "CorrelatedNormal, whose curvature needs no Hessian"
        )
    free = jnp.ones(n).at[problem.held()].set(0.0)
    drawn = _drawn(program, arguments, shapes, CANDIDATES * starts)
    scale = FIRST * drawn.std(0)
    if starts == 1:
        return _climb(problem, first, free, scale)
    heights = jax.lax.map(problem.value, drawn)
    best = jnp.argsort(jnp.where(jnp.isnan(heights), jnp.inf, heights))[: starts - 1]
    places = jnp.concatenate([first[None], drawn[best]])
    modes = jax.lax.map(lambda place: _climb(problem, place, free, scale), places)
    weight = jnp.where(modes.converged, modes.log_evidence, -jnp.inf)
    return jax.tree.map(lambda leaf: leaf[jnp.argmax(weight)], modes)


def _unconstrained(site: dict) -> Float[Array, "..."]:
    return dist.biject_to(site["fn"].support).inv(jnp.asarray(site["value"], dtype=jnp.float64))


def _drawn(
    program: Callable, arguments: dict, shapes: Whitening, n: int
) -> Float[Array, "draws unknowns"]:
    """Coordinates of samples from the prior."""

    def one(key):
        trace = handlers.trace(handlers.seed(program, key)).get_trace(**arguments)
        return shapes.from_values({name: _unconstrained(trace[name]) for name in shapes.names})

    return jax.lax.map(one, jax.random.split(jax.random.PRNGKey(1), n))


def _trace(program: Callable, arguments: dict, start: Mapping[str, Array]) -> dict:
    """One run of the program at the start."""
    median = infer.init_to_median(num_samples=31)

    def place(site):
        return start[site["name"]] if site["name"] in start else median(site)

    model = handlers.seed(program, jax.random.PRNGKey(0))
    return handlers.trace(handlers.substitute(model, substitute_fn=place)).get_trace(**arguments)


@eqx.filter_jit
def _climb(
    problem: Potential, first: Coordinates, free: Coordinates, scale: Coordinates
) -> LaplaceApproximation:
    """Newton's method with halved steps, using absolute values of negative curvature.

    free : 1 where x may move, 0 where it is fixed
    """

    def look(x, scale):
        """Newton's step at x, its length, and the coordinates' root."""
        gradient, curvature = problem.gradient_and_curvature(x, scale)
        # fixed sites keep only the diagonal, made positive: their block may not be
        diagonal = jnp.abs(jnp.diagonal(curvature))
        curvature = curvature * free[:, None] * free[None] + jnp.diag((1.0 - free) * diagonal)
        root, positive = root_of_inverse(curvature, problem)
        white = root.T @ (gradient * free)
        moved = jnp.sqrt((white**2).mean())
        moved = jnp.where(positive, moved, jnp.maximum(moved, 1.0))
        return root @ white, moved, root, jnp.minimum(1.0 / jnp.sqrt(diagonal), scale)

    def step(carry):
        x, value, direction, _, _, scale, n = carry

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
        # if no step leads downwards, the search has failed
        n = jnp.where(better, n + 1, MAX_STEPS)
        return x, jnp.where(better, trial, value), *look(x, scale), n

    def going(carry):
        moved, n = carry[3], carry[-1]
        return (~(moved < SETTLED)) & (n < MAX_STEPS)

    start = (first, problem.value(first), *look(first, scale), jnp.asarray(0))
    x, value, _, moved, root, _, n = jax.lax.while_loop(going, step, start)
    log_det = jnp.linalg.slogdet(root)[1]
    whitening = Whitening(x, root, log_det, problem.shapes.sites, problem.shapes.chart)
    return LaplaceApproximation(whitening, -value + log_det + x.shape[0] * HALF_LOG_2PI, moved, n)


# degrees of freedom of the proposal, whose tails are heavier than a Gaussian's
TAILS = 7.0


@dataclass(frozen=True)
class Evidence:
    """The evidence of a program.

    Attributes
    ----------
    log_evidence : float
        ln p(d).
    error : float
        Its standard error.
    effective : float
        Effective number of draws.
    laplace : LaplaceApproximation
        The Gaussian about the mode, behind the proposal.
    """

    log_evidence: float
    error: float
    effective: float
    laplace: LaplaceApproximation


def estimate_evidence(
    program: Program, arguments: Mapping[str, Any], data: DataVector, *, n: int = 400, seed: int = 0
) -> Evidence:
    """Estimate ln p(d) with everything that the program samples integrated out.

    Use it for programs with few sites, the sky integrated out. Trust it if the effective number of
    draws is a good share of ``n``.

    Parameters
    ----------
    program : Program
        The program.
    arguments : mapping
        Its arguments, without the data.
    data : (data,) array
        d, in K.
    n : int
        Number of draws.
    seed : int
        Seed of the draws.

    Raises
    ------
    InputError
        If the search for the posterior's mode does not converge.
    """
    arguments = {**arguments, DATA: jnp.asarray(data)}
    laplace = laplace_approximation(program.model, arguments)
    if not bool(laplace.converged):
        raise InputError(
            f"found no mode of the posterior in {int(laplace.steps)} steps (last step: "
            f"{float(laplace.moved):.2g} standard deviations); narrow the priors"
        )
    with numpyro_promotion():
        weights = np.asarray(_log_weights(program, arguments, laplace, n, jax.random.key(seed)))
    largest, relative = weights.max(), np.exp(weights - weights.max())
    error = relative.std(ddof=1) / relative.mean() / np.sqrt(n)
    effective = relative.sum() ** 2 / (relative**2).sum()
    log_evidence = largest + np.log(relative.mean())
    return Evidence(float(log_evidence), float(error), float(effective), laplace)


@eqx.filter_jit
def _log_weights(
    program: Program, arguments: dict[str, Any], laplace: LaplaceApproximation, n: int, key
) -> Float[Array, " draws"]:
    """ln of density over proposal, which is a Student t in the white coordinates."""
    whitening = laplace.whitening
    size = whitening.root.shape[1]
    proposal = dist.MultivariateStudentT(TAILS, jnp.zeros(size), jnp.eye(size))
    z = proposal.sample(key, (n,))

    model = whitened(program.model, whitening)
    site = f"{whitening.names[0]}{WHITE_SUFFIX}"
    log_p = jax.lax.map(lambda z: -potential_energy(model, (), arguments, {site: z}), z)
    return log_p - proposal.log_prob(z)


# number of pixels whose draws are in memory at once
CHUNK = 1024

# columns of summaries: the same with ArviZ 0.8 and 1.x
INTERVAL = 0.9


def pixel_statistics(skies: Skies, nside: int) -> dict[str, Float[np.ndarray, " pixels"]]:
    """Compute statistics of every pixel from the draws.

    Parameters
    ----------
    skies : (chains, draws, modes) array
        Draws, in K.
    nside : int
        NSIDE of the pixels.

    Returns
    -------
    dict of (pixels,) array
        ``mean``, ``std``, and the ends ``lower`` and ``upper`` of the 90 % interval, in K.
    """
    tails = [(1 - INTERVAL) / 2, (1 + INTERVAL) / 2]
    flat, parts = skies.reshape(-1, skies.shape[-1]), []
    matrix = pixel_matrix(nside, lmax_of(flat.shape[-1]))
    for first in range(0, len(matrix), CHUNK):
        values = flat @ matrix[first : first + CHUNK].T
        parts.append([values.mean(0), values.std(0, ddof=1), *np.quantile(values, tails, axis=0)])
    return dict(zip(("mean", "std", "lower", "upper"), np.concatenate(parts, axis=1), strict=True))


def sky_quantities(
    skies: Skies,
    *,
    modes: Sequence[tuple[int, int]] = (),
    ells: Sequence[int] = (),
    pixels: Mapping[str, Sequence[float]] | None = None,
) -> dict[str, Quantity]:
    """Compute chosen quantities of every draw, by name.

    Parameters
    ----------
    skies : (chains, draws, modes) array
        Draws, in K.
    modes : sequence of (int, int)
        Modes (ell, m).
    ells : sequence of int
        Multipoles of powers C_ell.
    pixels : mapping of sequences of float, optional
        Directions of brightnesses by name: Galactic longitude and latitude in degrees.

    Raises
    ------
    InputError
        For modes and ells beyond lmax.
    """
    lmax, columns = lmax_of(skies.shape[-1]), {}
    for name, (l_deg, b_deg) in (pixels or {}).items():
        columns[f"T({name}) [K]"] = skies @ harmonics_at(l_deg, b_deg, lmax)[0]
    spectra = power_spectrum(skies) if len(ells) else None
    for ell in ells:
        if not 0 <= ell <= lmax:
            raise InputError(f"ell = {ell} is outside 0..lmax = {lmax}")
        columns[f"C_{ell} [K2]"] = spectra[..., ell]
    for ell, m in modes:
        if not (0 <= ell <= lmax and abs(m) <= ell):
            raise InputError(f"(ell, m) = ({ell}, {m}) is not a mode up to lmax = {lmax}")
        columns[f"sky({ell}, {m}) [K]"] = skies[..., ell**2 + ell + m]
    return columns


def summary(quantities: Mapping[str, Quantity]) -> pd.DataFrame:
    """Make ArviZ's summary, a row for each quantity.

    It has mean, standard deviation, 90 % interval, bulk and tail ESS, R-hat and Monte Carlo
    errors.

    Parameters
    ----------
    quantities : mapping of (chains, draws) array
        Draws by name.
    """
    tree = arviz_base.from_dict({"posterior": dict(quantities)}, check_conventions=False)
    with np.errstate(all="ignore"):  # NaN marks chains that have not moved
        return arviz_stats.summary(tree, ci_prob=INTERVAL, ci_kind="eti", round_to="none")
