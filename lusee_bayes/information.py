"""What data say of a sky, as a quadratic form: all that is needed of them once they are read.

    ln p(d | m) = -1/2 [ chi^2 - 2 v.(m - m0) + (m - m0)^T M (m - m0) + ln|N| + N_data ln 2 pi ],
    M = A^T N^-1 A,    v = A^T N^-1 (d - A m0 - offset),    chi^2 = |L^-1 (d - A m0 - offset)|^2

about any sky m0. It is of the size of the sky, however many data there are; with a prior it gives
the posterior, with those of other frequencies a joint one. m0 is near the posterior mean: about
m = 0 the terms are 1e10 times larger than their sum.
"""

from __future__ import annotations

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from lusee_bayes.checks import (
    AnyArray,
    InputError,
    is_traced,
    require_finite,
    require_float64,
    require_shape,
)
from lusee_bayes.coupling import CouplingMatrix
from lusee_bayes.covariance import Covariance, Factor
from lusee_bayes.covariance.base import solve_lower
from lusee_bayes.gram import gram
from lusee_bayes.normal_matrix import has_structure, normal_matrix
from lusee_bayes.posterior import Posterior
from lusee_bayes.prior import Prior
from lusee_bayes.solver import CONVERGENCE

# the solution about m0 is repeated on what is left of its gradient
REFINEMENTS = 3


class Information(eqx.Module):
    """ln p(d | m) of some data as a function of the sky; see the module's equations.

    matrix : M, in 1/K^2; vector : v, in 1/K; about : m0, in K; misfit : chi^2 there;
    log_det : ln|N|; n_data : how many data, as a float
    perturbations : (n, modes) draws of A^T N^-1 n, n ~ N(0, N): for posterior draws by solving
    """

    matrix: Float[Array, "modes modes"]
    vector: Float[Array, " modes"]
    about: Float[Array, " modes"]
    misfit: Float[Array, ""]
    log_det: Float[Array, ""]
    n_data: Float[Array, ""]
    perturbations: Float[Array, "n modes"] | None = None

    @classmethod
    def of(
        cls,
        coupling: CouplingMatrix | Float[Array, "data modes"],
        prior: Prior,
        noise: Covariance,
        offset: Float[Array, " data"] | None,
        data: Float[AnyArray, " data"],
        key: PRNGKeyArray | None = None,
        n_perturbations: int = 0,
    ) -> tuple[Information, Posterior]:
        """What ``data`` say, about the posterior mean under a prior, and that posterior.

        A is not formed where N has structure in time. ``key``: for ``n_perturbations`` draws.
        InputError for data of the wrong length, and if N is not positive definite.
        """
        require_float64("the data", data)
        require_shape("the data", data, (noise.size,))
        require_finite("the data", data)
        factor = noise.factor()
        if has_structure(coupling, noise):
            matrix = normal_matrix(coupling, noise)
        else:
            coupling = coupling.dense() if isinstance(coupling, CouplingMatrix) else coupling
            matrix = gram(factor.whiten(coupling))
        centred = jnp.asarray(data) if offset is None else data - offset
        nothing, n_data = jnp.zeros(prior.size), jnp.asarray(float(noise.size))
        vector, misfit = _against(coupling, factor, centred, nothing)
        first = cls(matrix, vector, nothing, misfit, factor.log_det(), n_data)
        root = _diagonal_root(prior, n_modes=matrix.shape[0])
        lower = _precision_root(matrix, root)
        mean = prior.colour(_condition(first, root, lower, jnp.asarray(1))[0])
        vector, misfit = _against(coupling, factor, centred, mean)
        perturbations = None
        if n_perturbations:
            if key is None:
                raise InputError("give a key for the perturbations")
            drawn = noise.sample(key, n_perturbations)
            perturbations = jnp.stack([_against(coupling, factor, n, nothing)[0] for n in drawn])
        told = cls(matrix, vector, mean, misfit, first.log_det, n_data, perturbations)
        return told, told._posterior(prior, lower, 2)

    @property
    def n_modes(self) -> int:
        """Number of modes of the sky."""
        return self.about.shape[0]

    def recentred(self, sky: Float[Array, " modes"]) -> Information:
        """The same function, written about another sky."""
        require_shape("the sky", sky, (self.n_modes,))
        shift = sky - self.about
        pulled = self.matrix @ shift
        misfit = self.misfit - 2.0 * (self.vector @ shift) + shift @ pulled
        return replace(self, vector=self.vector - pulled, about=sky, misfit=misfit)

    def chi2(self, sky: Float[Array, " modes"]) -> Float[Array, ""]:
        """|L^-1 (d - A m - offset)|^2 of a sky m."""
        return self.recentred(sky).misfit

    def posterior(self, prior: Prior) -> Posterior:
        """The posterior over the sky under a prior that is diagonal in the modes.

        InputError for another prior, or if the mean does not converge.
        """
        lower = _precision_root(self.matrix, _diagonal_root(prior, self.n_modes))
        return self._posterior(prior, lower, REFINEMENTS)

    def _posterior(self, prior: Prior, lower: Array, refinements: int) -> Posterior:
        root = _diagonal_root(prior, self.n_modes)
        u, log_evidence, moved = _condition(self, root, lower, jnp.asarray(refinements))
        if not is_traced(moved) and not float(moved) <= CONVERGENCE:
            raise InputError(
                f"the posterior mean did not converge: its last step was {float(moved):.2g} "
                f"standard deviations (accepted: {CONVERGENCE:g}); the data are too precise for "
                "the normal equations, or far from anything that the prior allows"
            )
        return Posterior(prior, u, lower, None, log_evidence, moved)


def _diagonal_root(prior: Prior, n_modes: int) -> Float[Array, " modes"]:
    root = prior.diagonal_root()
    if root is None:
        raise InputError("information about modes needs a prior over the same modes")
    require_shape("the prior", root, (n_modes,))
    return root


@eqx.filter_jit
def _against(
    coupling: CouplingMatrix | Array, factor: Factor, data: Array, sky: Array
) -> tuple[Array, Array]:
    """A^T N^-1 (d - A m) and |L^-1 (d - A m)|^2."""
    white = factor.whiten(data - coupling @ sky)
    solved = factor.whiten_transpose(white)
    if isinstance(coupling, CouplingMatrix):
        return coupling.transpose_mv(solved), white @ white
    return coupling.T @ solved, white @ white


@eqx.filter_jit
def _precision_root(matrix: Float[Array, "modes modes"], root: Float[Array, " modes"]) -> Array:
    """L of the precision 1 + G M G of u = m / root."""
    normal = root[:, None] * matrix * root[None] + jnp.eye(len(root))
    return jax.lax.linalg.cholesky(normal, symmetrize_input=False)


@eqx.filter_jit
def _condition(
    information: Information, root: Array, lower: Array, refinements: Array
) -> tuple[Array, Array, Array]:
    """Mean of u, ln p(d), and the last step in standard deviations.

    u is found as a correction to that of m0; components without prior power are zero.
    """
    start = jnp.where(root > 0, information.about / jnp.where(root > 0, root, 1.0), 0.0)
    here = information.recentred(start * root)

    def refine(_, state):
        correction, _ = state
        pull = here.vector - here.matrix @ (root * correction)
        gradient = root * pull - (start + correction)
        half = solve_lower(lower, gradient[:, None], transpose=False)
        step = solve_lower(lower, half, transpose=True)[:, 0]
        return correction + step, jnp.linalg.norm(half)

    zero = (jnp.zeros_like(root), jnp.asarray(jnp.inf))
    correction, moved = jax.lax.fori_loop(0, refinements, refine, zero)
    u = start + correction
    log_evidence = -0.5 * (
        here.recentred(u * root).misfit
        + u @ u
        + here.log_det
        + 2.0 * jnp.log(jnp.diagonal(lower)).sum()
        + here.n_data * np.log(2.0 * np.pi)
    )
    return u, log_evidence, moved
