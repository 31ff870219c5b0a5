"""The joint posterior where its matrix does not fit: mean and exact draws by conjugate gradients.

Lambda = 1 + sum_f G_f^T M'_f G_f of the whitened component maps is only ever multiplied with. A
draw is the solution of Lambda x = b + e, where e, of covariance Lambda, is made of unit normals and
of each channel's perturbations (perturb and solve). The preconditioner solves the strongest
components together and takes the diagonal of the others.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from lusee_bayes.checks import AnyArray, InputError
from lusee_bayes.conjugate_gradients import conjugate_gradients
from lusee_bayes.covariance.base import solve_lower
from lusee_bayes.information import Information
from lusee_bayes.joint import common_part
from lusee_bayes.spectral_prior import SpectralPrior

# unknowns whose matrix is formed and factorised
DIRECT_UNKNOWNS = 10_000


@dataclass(frozen=True)
class IterativeSolution:
    """Component maps, in K, without their covariance.

    mean : (components, modes); draws : (n, components, modes); iterations, and the distance left in
    standard deviations of the whole posterior
    """

    mean: Float[Array, "components modes"]
    draws: Float[Array, "n components modes"]
    iterations: int
    distance: float


class Term(eqx.Module):
    """One channel's share of Lambda: M' of its common part, and G_f^T v', perturbations G_f^T e."""

    matrix: Float[Array, "modes modes"]
    columns: Float[Array, "components modes"]
    vector: Float[Array, "components modes"]
    perturbations: Float[Array, "n components modes"]

    @classmethod
    def of(
        cls,
        prior: SpectralPrior,
        channel: int,
        information: Information,
        about: Float[Array, "components modes"],
        key: PRNGKeyArray,
    ) -> Term:
        """Of a channel's information, about these component maps."""
        if information.perturbations is None:
            raise InputError("draws by conjugate gradients need information with perturbations")
        here = common_part(information, prior.residual_root(channel), key)
        here = here.recentred(prior.mixing[channel] @ about)
        columns = prior.mixing[channel][:, None] * prior.roots
        return cls(
            here.matrix,
            columns,
            columns * here.vector[None],
            columns[None] * here.perturbations[:, None],
        )

    def times(self, u: Float[Array, "systems components modes"]) -> Float[Array, "..."]:
        """G_f^T M' G_f u."""
        return _times(self.matrix, self.columns, u)


@eqx.filter_jit
def _times(matrix: Array, columns: Array, u: Array) -> Array:
    seen = (columns[None] * u).sum(1) @ matrix
    return columns[None] * seen[:, None]


def solve_iteratively(
    prior: SpectralPrior,
    channels: Iterable[Information],
    about: Float[AnyArray, "channels modes"],
    key: PRNGKeyArray,
    *,
    tolerance: float = 1e-7,
    iterations: int = 500,
    leading: int | None = None,
    report: Callable[[int, str], None] | None = None,
) -> IterativeSolution:
    """Mean and draws of the component maps: as many draws as the channels have perturbations.

    about : a sky for every channel, near the solution; leading : components that are solved
    together in the preconditioner, by default as many as fit into ``DIRECT_UNKNOWNS``. All M' are
    kept in memory. InputError if it does not converge.
    """
    k, roots = prior.n_components, prior.roots
    n = roots.shape[1]
    start = jnp.asarray(np.linalg.pinv(np.asarray(prior.mixing)) @ np.asarray(about))
    noise_key, unit_key = jax.random.split(key)
    terms = [
        Term.of(prior, channel, information, start, jax.random.fold_in(noise_key, channel))
        for channel, information in enumerate(channels)
    ]
    if len(terms) != prior.n_channels:
        raise InputError(f"there are {len(terms)} channels, the prior is for {prior.n_channels}")
    u0 = start / roots
    gradient = sum(term.vector for term in terms) - u0
    n_draws = min(term.perturbations.shape[0] for term in terms)
    z = jax.random.normal(unit_key, (n_draws, k, n), dtype=jnp.float64)
    noise = z + sum(term.perturbations[:n_draws] for term in terms)
    right = jnp.concatenate([gradient[None], gradient[None] + noise]).reshape(n_draws + 1, k * n)

    def apply(x: Array) -> Array:
        u = x.reshape(-1, k, n)
        total = u
        for term in terms:
            total = total + term.times(u)
        return total.reshape(x.shape)

    count = min(k, max(1, DIRECT_UNKNOWNS // n)) if leading is None else leading
    found = conjugate_gradients(
        apply,
        right,
        preconditioner(terms, count),
        tolerance=tolerance,
        iterations=iterations,
        report=report,
    )
    u = u0[None] + found.x.reshape(-1, k, n)
    maps = roots[None] * u
    return IterativeSolution(maps[0], maps[1:], found.iterations, float(found.distance.max()))


def preconditioner(terms: list[Term], leading: int) -> Callable[[Array], Array]:
    """P: the inverse of Lambda's block of the first ``leading`` components, 1 / its diagonal else.

    InputError if that block is not positive definite.
    """
    k, n = terms[0].columns.shape
    block = jnp.eye(leading * n)
    diagonal = jnp.ones((k - leading, n))
    for term in terms:
        block = _add_block(block, term.matrix, term.columns[:leading])
        diagonal = diagonal + term.columns[leading:] ** 2 * jnp.diagonal(term.matrix)[None]
    lower = jax.lax.linalg.cholesky(block, symmetrize_input=False)
    if not bool(jnp.isfinite(jnp.diagonal(lower)).all()):
        raise InputError("the preconditioner could not be factorised: the data are too precise")
    return lambda r: _precondition(lower, diagonal.reshape(-1), r)


@eqx.filter_jit
def _add_block(block: Array, matrix: Array, columns: Array) -> Array:
    k, n = columns.shape
    rows = [
        jnp.concatenate([columns[i][:, None] * matrix * columns[j][None] for j in range(k)], 1)
        for i in range(k)
    ]
    return block + jnp.concatenate(rows).reshape(k * n, k * n)


@eqx.filter_jit
def _precondition(lower: Array, diagonal: Array, r: Array) -> Array:
    first, others = r[:, : lower.shape[0]], r[:, lower.shape[0] :]
    half = solve_lower(lower, first.T, transpose=False)
    solved = solve_lower(lower, half, transpose=True).T
    return jnp.concatenate([solved, others / diagonal[None]], axis=1)
