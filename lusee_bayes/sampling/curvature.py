"""Minus the log posterior of a program, its gradient and its curvature."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from numpyro import distributions as dist
from numpyro import handlers
from numpyro.infer.util import potential_energy

from lusee_bayes.core.arrays import Array
from lusee_bayes.sampling.distributions import Prediction
from lusee_bayes.sampling.whitening import Whitening

# step of the differences that give the Hessian, in standard deviations
DIFFERENCE = 0.1
# columns of the Jacobian at once: more would take more memory than time they save
COLUMNS = 64


class Potential(eqx.Module):
    """Minus the log posterior of a program's unconstrained coordinates x.

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
        Sites that are held where they are.
    """

    program: Callable = eqx.field(static=True)
    arguments: dict[str, Any]
    shapes: Whitening
    predicts: bool = eqx.field(static=True)
    hold: tuple[str, ...] = eqx.field(static=True)

    def held(self) -> np.ndarray:
        """Return the positions in x of what is held."""
        sites = self.shapes.sites
        parts = [np.full(int(np.prod(shape)), name in self.hold) for name, shape in sites]
        return np.flatnonzero(np.concatenate(parts))

    def values(self, x: Float[Array, " n"], still: bool) -> tuple[dict[str, Array], Array]:
        """Return the sites' values at x, and ln|det| of their Jacobian; ``still`` as in value."""
        parts = self.shapes.split(x)
        for name in self.hold if still else ():
            if name in parts:
                parts[name] = jax.lax.stop_gradient(parts[name])
        return (
            (parts, jnp.zeros(()))
            if self.shapes.chart is None
            else self.shapes.chart.to_values(parts)
        )

    def value(self, x: Float[Array, " n"], still: bool = False) -> Float[Array, ""]:
        """Return it at x; ``still``: without derivatives by what is held."""
        values, log_det = self.values(x, still)
        return potential_energy(self.program, (), self.arguments, values) - log_det

    def residual(self, x: Float[Array, " n"], still: bool = False) -> Float[Array, " data"]:
        """Return the residuals of all sites that predict, such as L^-1 (d - f(x)), N = L L^T."""
        found = self._predictions(x, still)
        return jnp.concatenate([fn.residual(value) for fn, value in found])

    def misfit(self, x: Float[Array, " n"], still: bool = False) -> Float[Array, ""]:
        """Return the misfit of all sites that predict, such as chi^2 / 2."""
        return sum((fn.misfit(value) for fn, value in self._predictions(x, still)), jnp.zeros(()))

    def _predictions(self, x: Float[Array, " n"], still: bool) -> list[tuple[Prediction, Array]]:
        values, _ = self.values(x, still)

        def place(site):
            if site["name"] in values:
                return dist.biject_to(site["fn"].support)(values[site["name"]])
            return None

        model = handlers.substitute(handlers.seed(self.program, 0), substitute_fn=place)
        return [
            (site["fn"], site["value"])
            for site in handlers.trace(model).get_trace(**self.arguments).values()
            if site["type"] == "sample" and isinstance(site["fn"], Prediction)
        ]

    def slope(self, x: Float[Array, " n"]) -> Float[Array, " n"]:
        """Return the gradient at x."""
        return jax.grad(self.value)(x)

    def gradient_and_curvature(
        self, x: Float[Array, " n"], scale: Float[Array, " n"]
    ) -> tuple[Float[Array, " n"], Float[Array, "n n"]]:
        """Return both at x; ``scale``: lengths over which the potential is a parabola.

        The curvature is that of Gauss and Newton where the program predicts the data, else the
        Hessian by differences of gradients.
        """
        if not self.predicts:
            # all in one map: second derivatives of banded factors take minutes to compile
            steps = DIFFERENCE * jnp.diag(scale)
            places = jnp.concatenate([x[None], x[None] + steps, x[None] - steps])
            gradients = jax.lax.map(self.slope, places)
            up, down = jnp.split(gradients[1:], 2)
            slopes = (up - down) / (2.0 * DIFFERENCE * scale[:, None])
            return gradients[0], 0.5 * (slopes + slopes.T)

        def prior(x, still=False):
            return self.value(x, still) - self.misfit(x, still)

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


def without_held(curvature: Float[Array, "n n"], free: Float[Array, " n"]) -> Float[Array, "n n"]:
    """Keep only the diagonal, made positive, of what is held: its block may not be positive."""
    held = (1.0 - free) * jnp.abs(jnp.diagonal(curvature))
    return curvature * free[:, None] * free[None] + jnp.diag(held)


def root_of_inverse(curvature: Float[Array, "n n"], problem: Potential) -> tuple[Array, Array]:
    """Return R and whether all curvature is positive; R R^T inverts its absolute value."""
    if not problem.predicts:
        return _root_of_any_sign(curvature)
    lower = jnp.linalg.cholesky(curvature)
    unit = jnp.eye(curvature.shape[0])
    root = jax.scipy.linalg.solve_triangular(lower, unit, lower=True).T
    if problem.shapes.chart is None:
        return root, jnp.asarray(True)
    # a prior in curved coordinates need not curve upwards everywhere
    positive = jnp.isfinite(root).all()
    return jax.lax.cond(positive, lambda: (root, positive), lambda: _root_of_any_sign(curvature))


def _root_of_any_sign(curvature: Float[Array, "n n"]) -> tuple[Array, Array]:
    # in units of its own diagonal, since parameters come in any
    scale = 1.0 / jnp.sqrt(jnp.abs(jnp.diagonal(curvature)))
    values, vectors = jnp.linalg.eigh(curvature * scale[:, None] * scale[None])
    least = np.finfo(np.float64).eps * jnp.abs(values).max()
    strength = jnp.maximum(jnp.abs(values), least)
    return scale[:, None] * vectors / jnp.sqrt(strength)[None], (values > 0).all()
