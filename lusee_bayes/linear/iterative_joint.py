"""The joint posterior where its matrix is too large: mean and exact draws by conjugate gradients.

Lambda = 1 + sum_f G_f^T M'_f G_f, of the whitened component maps, is never formed. A draw is the
solution of Lambda x = b + e, where e ~ N(0, Lambda) is made of unit normals and of each channel's
perturbations (perturb and solve). The preconditioner solves for the strongest components together
and takes the diagonal of the others.

References
----------
Papandreou & Yuille, "Gaussian sampling by local perturbations", NIPS 2010.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Float, PRNGKeyArray

from lusee_bayes.core.arrays import Array, on_device
from lusee_bayes.core.conjugate_gradients import conjugate_gradients
from lusee_bayes.core.errors import InputError
from lusee_bayes.core.linalg import solve_lower
from lusee_bayes.linear.information import Information
from lusee_bayes.linear.joint import common_part, reference_maps
from lusee_bayes.sky.spectral_prior import SpectralPrior

# most unknowns whose matrix is formed and factorised
DIRECT_UNKNOWNS = 10_000


@dataclass(frozen=True)
class IterativeSolution:
    """Component maps without their covariance.

    Attributes
    ----------
    mean : (components, modes) array
        In K.
    draws : (n, components, modes) array
        In K.
    iterations : int
        Iterations of conjugate gradients.
    distance : float
        Estimated distance to the solution in standard deviations of the whole posterior, the
        largest over mean and draws.
    """

    mean: Float[Array, "components modes"]
    draws: Float[Array, "n components modes"]
    iterations: int
    distance: float


class Term(eqx.Module):
    """One channel's term of Lambda and of the right-hand sides.

    Attributes
    ----------
    matrix : (modes, modes) array
        M' of the common part, in 1/K^2.
    columns : (components, modes) array
        G_f: the diagonals of s_fc S_c^1/2, in K.
    vector : (components, modes) array
        G_f^T v'.
    perturbations : (n, components, modes) array
        Draws of G_f^T e with e ~ N(0, M').
    """

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
        reference: Float[Array, "components modes"],
        key: PRNGKeyArray,
    ) -> Term:
        """Make the term of a channel.

        Parameters
        ----------
        prior : SpectralPrior
            Of all channels.
        channel : int
            Number of the channel in the prior.
        information : Information
            Of the channel's data, with perturbations.
        reference : (components, modes) array
            Reference maps, in K.
        key : PRNGKeyArray
            For the perturbations.

        Returns
        -------
        Term
            For unknowns counted from the reference maps.

        Raises
        ------
        InputError
            If the information has no perturbations.
        """
        if information.perturbations is None:
            raise InputError("draws by conjugate gradients need information with perturbations")
        prior, information = on_device((prior, information))
        here = common_part(information, prior.residual_root(channel), key)
        here = here.recentred(prior.mixing[channel] @ reference)
        columns = prior.mixing[channel][:, None] * prior.roots
        return cls(
            here.matrix,
            columns,
            columns * here.vector[None],
            columns[None] * here.perturbations[:, None],
        )

    def times(
        self, u: Float[Array, "systems components modes"]
    ) -> Float[Array, "systems components modes"]:
        """Multiply with the term of Lambda.

        Parameters
        ----------
        u : (systems, components, modes) array
            Whitened component maps.

        Returns
        -------
        (systems, components, modes) array
            G_f^T M' G_f u.
        """
        return _times(self.matrix, self.columns, u)


@eqx.filter_jit
def _times(matrix: Array, columns: Array, u: Array) -> Array:
    seen = (columns[None] * u).sum(1) @ matrix
    return columns[None] * seen[:, None]


def solve_iteratively(
    prior: SpectralPrior,
    channels: Iterable[Information],
    reference: Float[Array, "channels modes"],
    key: PRNGKeyArray,
    *,
    tolerance: float = 1e-7,
    iterations: int = 500,
    leading: int | None = None,
    report: Callable[[int, str], None] | None = None,
) -> IterativeSolution:
    """Compute mean and draws of the component maps by conjugate gradients.

    The matrices M' of all channels are kept in memory.

    Parameters
    ----------
    prior : SpectralPrior
        Of all channels.
    channels : iterable of Information
        In the prior's order, with perturbations: as many draws are made as every channel has.
    reference : (channels, modes) array
        A reference sky for every channel, near its posterior mean, in K.
    key : PRNGKeyArray
        For the draws.
    tolerance : float
        Accepted distance to the solution, in standard deviations of the whole posterior.
    iterations : int
        Most iterations.
    leading : int, optional
        Components that the preconditioner solves for together; by default as many as fit into
        ``DIRECT_UNKNOWNS``.
    report : callable, optional
        Called with the number of every iteration and a remark.

    Returns
    -------
    IterativeSolution
        Mean and draws.

    Raises
    ------
    InputError
        If there are more or fewer channels than the prior has, one of them has no perturbations,
        or the iteration does not converge.
    """
    k, roots = prior.n_components, jnp.asarray(prior.roots)
    n = roots.shape[1]
    start = jnp.asarray(reference_maps(prior, reference))
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
    """Make P: the inverse of Lambda's block of the first components, 1 / its diagonal elsewhere.

    Parameters
    ----------
    terms : list of Term
        Of all channels.
    leading : int
        Components in the block.

    Returns
    -------
    callable
        P on rows of a (systems, components * modes) array.

    Raises
    ------
    InputError
        If the block is not positive definite.
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
