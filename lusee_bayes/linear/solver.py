"""Factorising and solving the linear Gaussian model.

With N = L L^T, S = G G^T and the whitened sky u (m = G u), set W = L^-1 A G and w = L^-1 d. Then ::

    Lambda = 1 + W^T W,   u | d ~ N(Lambda^-1 W^T w, Lambda^-1),
    log p(d) = -1/2 [ |w - W u|^2 + |u|^2 + ln|N| + ln|Lambda| + N_data ln 2 pi ]    (u the mean),

the equations of the map-space form, preconditioned. (Where the prior has a mean mu, d is less
A mu, and u is that of m - mu.) With fewer data than modes the same is done in
the row space of W: W^T = Q R (Householder), u = Q v + (a part that only the prior knows),
Lambda_v = 1 + R R^T of the size of the data. It equals S A^T (A S A^T + N)^-1 d without the
cancellation of S - S A^T (...)^-1 A S, which loses the variance of well measured modes.

W^T W squares the signal-to-noise ratio s of the best measured mode: in the map-space form standard
deviations are good to eps s^2 at worst (1e-6 in the fiducial case; Posterior.std checks it), in the
other to eps s. So they are in the root form, which takes the same L from the QR decomposition of
(W, 1) at three times the cost. The mean is refined to the same quality in all of them.
"""

from __future__ import annotations

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from lusee_bayes.core.arrays import Array, DataVector
from lusee_bayes.core.checks import is_traced, require_array
from lusee_bayes.core.errors import InputError
from lusee_bayes.core.linalg import gram_matrix, solve_lower
from lusee_bayes.instrument.coupling import Coupling
from lusee_bayes.linear.posterior import Posterior
from lusee_bayes.noise.covariance import Covariance, Factor
from lusee_bayes.sky.prior import Prior

FORMS = ("map", "data", "root")

# a mean is accepted when its last refinement moved no coefficient of u by more than this many
# posterior standard deviations
CONVERGENCE = 1e-6
MAX_REFINEMENTS = 10


def unfinished(most: int = MAX_REFINEMENTS) -> Callable:
    """Whether a mean is to be refined once more, at most so often.

    The state is the mean, the length of the last step and of that before, and the number of steps.
    """

    def more(state):
        _, moved, before, count = state
        # what is left may be rounding, which no refinement makes smaller
        settled = (moved < CONVERGENCE) & (moved > 0.5 * before)
        return (count < 1) | ((moved > 1e-3 * CONVERGENCE) & ~settled & (count < most))

    return more


class Solver(eqx.Module):
    """A factorised model, which conditions on data vectors at the cost of a few products each.

    Attributes
    ----------
    prior : Prior
        S = G G^T.
    factor : Factor
        L of N = L L^T.
    whitened : (data, white) array
        W = L^-1 A G.
    lower : (rank, rank) array
        Cholesky factor of Lambda, or of Lambda_v where ``basis`` is given.
    basis : (white, rank) array or None
        Q of the data-space form; None in the others.
    offset : (data,) array or None
        Mean of the data without a sky, in K.
    """

    prior: Prior
    factor: Factor
    whitened: Float[Array, "data white"]
    lower: Float[Array, "rank rank"]
    basis: Float[Array, "white rank"] | None
    offset: DataVector | None

    def condition(self, data: DataVector) -> Posterior:
        """Compute the posterior over the sky given data.

        Parameters
        ----------
        data : (data,) array
            d, in K.

        Returns
        -------
        Posterior
            With the evidence of the data.

        Raises
        ------
        InputError
            If the data are not float64, not finite or of another length, or the refinement of the
            mean does not converge.
        """
        u, log_evidence, moved = self._solve(data)
        return Posterior(self.prior, u, self.lower, self.basis, log_evidence, moved)

    def log_prob(self, data: DataVector) -> Float[Array, ""]:
        """Compute the evidence ln p(d).

        Parameters
        ----------
        data : (data,) array
            d, in K.

        Returns
        -------
        () array
            ln p(d), for data in K.

        Raises
        ------
        InputError
            As :meth:`condition`.
        """
        return self._solve(data)[1]

    def surprise(self, data: DataVector) -> DataVector:
        """Compute L^-1 (d - E[d]), where E[d] is what the prior's mean sky predicts.

        Parameters
        ----------
        data : (data,) array
            d, in K.

        Returns
        -------
        (data,) array
            White data, of which the model says N(0, 1 + W W^T).
        """
        white = self.factor.whiten(data if self.offset is None else data - self.offset)
        mean = self.prior.white_mean
        return white if mean is None else white - self.whitened @ mean

    def half(self) -> Float[Array, "rank data"]:
        """Compute H with (A S A^T + N)^-1 = L^-T (1 - H^T H) L^-1.

        Returns
        -------
        (rank, data) array
            L_Lambda^-1 W^T; in the data-space form L_v^-1 R.
        """
        inside = self.whitened if self.basis is None else self.whitened @ self.basis
        return solve_lower(self.lower, inside.T, transpose=False)

    def _solve(self, data: DataVector) -> tuple[Array, Array, Array]:
        require_array("the data", data, (self.whitened.shape[0],))
        u, log_evidence, moved = _solve(self, jnp.asarray(data))
        if not is_traced(moved) and not float(moved) <= CONVERGENCE:
            raise InputError(
                f"the posterior mean did not converge: after {MAX_REFINEMENTS} refinements it "
                f"still moves by {float(moved):.2g} standard deviations (accepted: "
                f"{CONVERGENCE:g}); the noise is too small for float64 arithmetic"
            )
        return u, log_evidence, moved


def factorise(
    coupling: Coupling, prior: Prior, noise: Covariance, offset: DataVector | None, form: str
) -> Solver:
    """Factorise d = A m + offset + n.

    Parameters
    ----------
    coupling : Coupling
        A, of shape (data, unknowns).
    prior : Prior
        S, in K^2.
    noise : Covariance
        N, in K^2.
    offset : (data,) array or None
        Mean of the data without a sky, in K; None for zero.
    form : {"map", "data", "root"}
        One of ``FORMS``.

    Returns
    -------
    Solver
        The factorised model.

    Raises
    ------
    InputError
        If N is not positive definite, or Lambda cannot be factorised.
    """
    solver = _factorise(coupling, prior, noise, offset, form)
    if not is_traced(solver.lower) and not np.isfinite(np.diagonal(solver.lower)).all():
        noise.factor()  # outside jit: raises and names the term that is not positive
        raise InputError(
            "Lambda = 1 + W^T W could not be factorised: the data are too precise for the normal "
            "equations; use form='data'"
        )
    return solver


@eqx.filter_jit
def _factorise(
    coupling: Coupling, prior: Prior, noise: Covariance, offset: DataVector | None, form: str
) -> Solver:
    factor = noise.factor()
    whitened = factor.whiten(prior.colour_columns(coupling.dense()))
    if form == "root":
        stacked = jnp.concatenate([whitened, jnp.eye(whitened.shape[1])])
        triangle = jnp.linalg.qr(stacked, mode="r")
        lower = triangle.T * jnp.sign(jnp.diagonal(triangle))[None]
        return Solver(prior, factor, whitened, lower, None, offset)
    if form == "map":
        basis, normal = None, gram_matrix(whitened)
    else:
        basis, triangle = jnp.linalg.qr(jax.lax.stop_gradient(whitened).T)
        normal = triangle @ triangle.T
    normal = normal + jnp.eye(normal.shape[0])
    lower = jax.lax.linalg.cholesky(normal, symmetrize_input=False)
    return Solver(prior, factor, whitened, lower, basis, offset)


@jax.custom_jvp
def _log_det_in_span(whitened: Array, lower: Array) -> Array:
    """ln|1 + W W^T| from the factor of the data form, whose QR has no derivative at low rank."""
    return 2.0 * jnp.log(jnp.diagonal(lower)).sum()


@_log_det_in_span.defjvp
def _log_det_in_span_jvp(primals, tangents):
    """d ln|1 + W W^T| = 2 sum( (1 + W W^T)^-1 W * dW )."""
    whitened, lower = primals
    gram_of_data = jnp.eye(whitened.shape[0]) + whitened @ whitened.T
    slope = jax.scipy.linalg.cho_solve((jnp.linalg.cholesky(gram_of_data), True), whitened)
    return _log_det_in_span(whitened, lower), 2.0 * (slope * tangents[0]).sum()


def _newton(
    whitened: Array, lower: Array, basis: Array | None, white: Array, u: Array
) -> tuple[Array, Array]:
    """u plus Lambda^-1 (W^T (w - W u) - u), and the length of that step in standard deviations."""
    gradient = whitened.T @ (white - whitened @ u) - u
    projected = gradient if basis is None else basis.T @ gradient
    half = solve_lower(lower, projected[:, None], transpose=False)
    step = solve_lower(lower, half, transpose=True)[:, 0]
    if basis is not None:
        # outside the span of W^T, Lambda is 1 and the gradient is zero but for rounding; it is
        # kept only in derivatives
        outside = gradient - basis @ projected
        step = basis @ step + (outside - jax.lax.stop_gradient(outside))
    return u + step, jnp.linalg.norm(half)


@eqx.filter_jit
def _solve(solver: Solver, data: DataVector) -> tuple[Array, Array, Array]:
    """Mean of u, log evidence, and size of the last refinement in standard deviations.

    The normal equations square the condition number; repeating the solve on the residual
    (corrected seminormal equations) restores what they lose. Derivatives do not go through the
    iteration: at its fixed point one more step with live arrays carries them exactly.
    """
    white = solver.surprise(data)
    live = (solver.whitened, solver.lower, solver.basis, white)
    frozen = jax.lax.stop_gradient(live)

    def refine(state):
        u, moved = _newton(*frozen, state[0])
        return u, moved, state[1], state[3] + 1

    first, _ = _newton(*frozen, jnp.zeros(solver.whitened.shape[1]))
    u, moved, _, _ = jax.lax.while_loop(unfinished(), refine, (first, jnp.inf, jnp.inf, 0))
    fixed = (solver.whitened, *frozen[1:3], white)
    u, _ = _newton(*fixed, jax.lax.stop_gradient(u))
    misfit = white - solver.whitened @ u
    if solver.basis is None:
        log_det = 2.0 * jnp.log(jnp.diagonal(solver.lower)).sum()
    else:
        log_det = _log_det_in_span(solver.whitened, frozen[1])
    log_evidence = -0.5 * (
        misfit @ misfit
        + u @ u
        + solver.factor.log_det()
        + log_det
        + white.shape[0] * np.log(2.0 * np.pi)
    )
    # u was that of the sky's deviation from the prior's mean
    mean = solver.prior.white_mean
    return u if mean is None else u + mean, log_evidence, moved
