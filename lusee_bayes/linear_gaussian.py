"""The linear Gaussian model d = A m + n and its posterior over m.

With N = L L^T, S = G G^T and the whitened sky u (m = G u), set W = L^-1 A G and w = L^-1 d. Then

    Lambda = 1 + W^T W,   u | d ~ N(Lambda^-1 W^T w, Lambda^-1),
    log p(d) = -1/2 [ |w - W u|^2 + |u|^2 + ln|N| + ln|Lambda| + N_data ln 2 pi ]    (u the mean),

which are the equations of the map-space form, preconditioned. With fewer data than modes the same
is done in the row space of W: W^T = Q R (Householder), u = Q v + (a part that only the prior
knows), Lambda_v = 1 + R R^T of the size of the data. It equals S A^T (A S A^T + N)^-1 d without
the cancellation of S - S A^T (...)^-1 A S, which loses the variance of well measured modes.

W^T W squares the signal-to-noise ratio s of the best measured mode: in the map-space form standard
deviations are good to eps s^2 at worst (1e-6 in the fiducial case; Posterior.std checks it), in the
other to eps s. The mean is refined to the same quality in both.
"""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from lusee_bayes.checks import (
    AnyArray,
    InputError,
    is_traced,
    nearest,
    require_finite,
    require_float64,
    require_shape,
)
from lusee_bayes.coupling import CouplingMatrix
from lusee_bayes.covariance import Covariance, Factor
from lusee_bayes.covariance.base import solve_lower
from lusee_bayes.gram import gram
from lusee_bayes.posterior import Posterior
from lusee_bayes.prior import Prior

FORMS = ("map", "data")

# A mean is accepted when its last refinement moved no coefficient of u by more than this many
# posterior standard deviations.
CONVERGENCE = 1e-6
MAX_REFINEMENTS = 10


class LinearGaussian(eqx.Module):
    """d = A m + offset + n, m ~ N(0, S), n ~ N(0, N): a distribution over data vectors.

    coupling : A, structured or a (data, modes) array; prior : S; noise : N;
    offset : (data,) what the data hold on average without any sky, in K; None for nothing.
    """

    coupling: CouplingMatrix | Float[Array, "data unknowns"]
    prior: Prior
    noise: Covariance
    offset: Float[Array, " data"] | None = None

    def __check_init__(self):
        if not isinstance(self.coupling, CouplingMatrix):
            require_float64("the coupling matrix", self.coupling)
            require_finite("the coupling matrix", self.coupling)
        n_data, n_unknowns = self.coupling.shape
        if self.noise.size != n_data:
            raise InputError(
                f"the coupling matrix has {n_data} rows, the noise covariance {self.noise.size}; "
                "build both for the same observation and flags"
            )
        if self.prior.size != n_unknowns:
            raise InputError(
                f"the coupling matrix has {n_unknowns} columns, the prior {self.prior.size} "
                "unknowns; give both the same lmax"
            )
        if self.offset is not None:
            require_float64("the offset", self.offset)
            require_shape("the offset", self.offset, (n_data,))
            require_finite("the offset", self.offset)

    @property
    def n_data(self) -> int:
        """Number of data."""
        return self.coupling.shape[0]

    def sample(self, key: PRNGKeyArray) -> tuple[Float[Array, " unknowns"], Float[Array, " data"]]:
        """A sky from the prior and a data vector of it: (m, d)."""
        sky_key, noise_key = jax.random.split(key)
        sky = self.prior.sample(sky_key)
        data = self.coupling @ sky + self.noise.sample(noise_key)
        return sky, data if self.offset is None else data + self.offset

    def factorise(self, form: str | None = None) -> Solver:
        """Everything that does not depend on the data; use it to condition on many data vectors.

        ``form``: "map" or "data"; None takes the cheaper one from the sizes. InputError if N is
        not positive definite.
        """
        if form is None:
            form = "data" if self.n_data < self.prior.rank else "map"
        if form not in FORMS:
            raise InputError(f"unknown form '{form}'; {nearest(form, FORMS)}")
        solver = _factorise(self, form)
        if not is_traced(solver.lower):
            _check_factors(self, solver)
        return solver

    def condition(self, data: Float[AnyArray, " data"], form: str | None = None) -> Posterior:
        """The posterior over the sky given ``data`` (data,), in K."""
        return self.factorise(form).condition(data)

    def log_prob(self, data: Float[AnyArray, " data"]) -> Float[Array, ""]:
        """ln p(d), the evidence: the sky is integrated out. Differentiable."""
        return self.factorise().log_prob(data)


class Solver(eqx.Module):
    """A factorised model: conditions on data vectors at the cost of a few products each."""

    prior: Prior
    factor: Factor
    whitened: Float[Array, "data white"]
    lower: Float[Array, "rank rank"]
    basis: Float[Array, "white rank"] | None
    offset: Float[Array, " data"] | None

    def condition(self, data: Float[AnyArray, " data"]) -> Posterior:
        """The posterior over the sky given ``data``.

        InputError for data that are not float64, not finite or of the wrong length, and if the
        refinement of the mean does not converge.
        """
        u, log_evidence, moved = self._solve(data)
        return Posterior(
            prior=self.prior,
            white_mean=u,
            lower=self.lower,
            basis=self.basis,
            log_evidence=log_evidence,
            refinement=moved,
        )

    def log_prob(self, data: Float[AnyArray, " data"]) -> Float[Array, ""]:
        """ln p(d); the same errors as :meth:`condition`."""
        return self._solve(data)[1]

    def _solve(self, data: Float[AnyArray, " data"]) -> tuple[Array, Array, Array]:
        require_float64("the data", data)
        require_shape("the data", data, (self.whitened.shape[0],))
        require_finite("the data", data)
        u, log_evidence, moved = _solve(self, jnp.asarray(data))
        if not is_traced(moved) and not float(moved) <= CONVERGENCE:
            raise InputError(
                f"the posterior mean did not converge: after {MAX_REFINEMENTS} refinements it "
                f"still moves by {float(moved):.2g} standard deviations (accepted: "
                f"{CONVERGENCE:g}); the noise is too small for float64 arithmetic"
            )
        return u, log_evidence, moved


def _check_factors(model: LinearGaussian, solver: Solver) -> None:
    """InputError if N or Lambda could not be factorised."""
    if not np.isfinite(np.asarray(jnp.diagonal(solver.lower))).all():
        model.noise.factor()  # outside jit: raises and names the term that is not positive
        raise InputError(
            "Lambda = 1 + W^T W could not be factorised: the data are too precise for the normal "
            "equations; use form='data'"
        )


@eqx.filter_jit
def _factorise(model: LinearGaussian, form: str) -> Solver:
    dense = model.coupling
    if isinstance(dense, CouplingMatrix):
        dense = dense.dense()
    factor = model.noise.factor()
    whitened = factor.whiten(model.prior.colour_columns(dense))
    if form == "map":
        basis, normal = None, gram(whitened)
    else:
        basis, triangle = jnp.linalg.qr(jax.lax.stop_gradient(whitened).T)
        normal = triangle @ triangle.T
    normal = normal + jnp.eye(normal.shape[0])
    lower = jax.lax.linalg.cholesky(normal, symmetrize_input=False)
    return Solver(model.prior, factor, whitened, lower, basis, model.offset)


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
def _solve(solver: Solver, data: Float[Array, " data"]) -> tuple[Array, Array, Array]:
    """Mean of u, log evidence, and size of the last refinement in standard deviations.

    The normal equations square the condition number; repeating the solve on the residual
    (corrected seminormal equations) restores what they lose. Derivatives do not go through the
    iteration: at its fixed point one more step with live arrays carries them exactly.
    """
    white = solver.factor.whiten(data if solver.offset is None else data - solver.offset)
    live = (solver.whitened, solver.lower, solver.basis, white)
    frozen = jax.lax.stop_gradient(live)

    def unfinished(state):
        _, moved, count = state
        return (count < 1) | ((moved > 1e-3 * CONVERGENCE) & (count < MAX_REFINEMENTS))

    def refine(state):
        u, moved = _newton(*frozen, state[0])
        return u, moved, state[2] + 1

    first, _ = _newton(*frozen, jnp.zeros(solver.whitened.shape[1]))
    u, moved, _ = jax.lax.while_loop(unfinished, refine, (first, jnp.inf, 0))
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
    return u, log_evidence, moved
