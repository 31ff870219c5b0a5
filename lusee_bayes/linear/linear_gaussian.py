"""The linear Gaussian model d = A m + n, and its solutions.

It is a distribution over data, with a posterior over m, ::

    Lambda = A^T N^-1 A + S^-1,    C = Lambda^-1,    mean = C A^T N^-1 d

With N = L L^T, S = G G^T and the whitened sky u (m = G u), set W = L^-1 A G and w = L^-1 d. Then ::

    Lambda = 1 + W^T W,   u | d ~ N(Lambda^-1 W^T w, Lambda^-1),
    log p(d) = -1/2 [ |w - W u|^2 + |u|^2 + ln|N| + ln|Lambda| + N_data ln 2 pi ]    (u the mean),

the equations of the map-space form, preconditioned. (If the prior has a mean mu, d stands for
d - A mu, and m = G u for m - mu.) The forms are classes with one interface:

- :class:`InData`, for fewer data than modes: the same in the row space of W. W^T = Q R
  (Householder), u = Q v + (a part that only the prior constrains), and Lambda_v = 1 + R R^T has the
  size of the data. It equals S A^T (A S A^T + N)^-1 d, without the cancellation in
  S - S A^T (...)^-1 A S, which loses the variance of well measured modes.
- :class:`FromInformation`, for more data: from A^T N^-1 A in NumPy, without forming A if A and N
  have structure in time (:mod:`.normal_matrix`).
- :class:`InMap`, its replacement if a model is differentiated or traced: from W in JAX.

W^T W squares the signal-to-noise ratio s of the best measured mode. Standard deviations are thus
accurate to eps s^2 at worst in map space (1e-6 in the fiducial case; Posterior.std checks it), and
to eps s in data space. All forms refine the mean to the same accuracy.

Data sets with independent noise are combined by adding their :class:`.Information`.
"""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass, replace
from functools import cached_property

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, PRNGKeyArray

from lusee_bayes.core.arrays import Array, DataVector, Modes, ModesMatrix, namespace, on_host
from lusee_bayes.core.checks import Described, is_traced, require_array, require_shape
from lusee_bayes.core.errors import InputError
from lusee_bayes.core.linalg import gram_matrix, solve_lower
from lusee_bayes.instrument.coupling import Coupling, DenseCoupling, as_coupling
from lusee_bayes.linear import information as of_data
from lusee_bayes.linear.normal_matrix import has_structure, normal_matrix
from lusee_bayes.linear.posterior import Posterior
from lusee_bayes.noise.covariance import Covariance, Factor, LowRankFactor, LowRankUpdate
from lusee_bayes.sky.prior import Prior


class LinearGaussian(Described, eqx.Module):
    """d = A m + offset + n, m ~ N(mu, S), n ~ N(0, N): a distribution over data vectors.

    Parameters
    ----------
    coupling : Coupling or (data, unknowns) array
        A. An array is wrapped in a ``DenseCoupling``.
    prior : Prior
        S, in K^2, and mu if it is not zero.
    noise : Covariance
        N, in K^2.
    offset : (data,) array or None
        Mean of the data without a sky, in K; None for zero.

    Raises
    ------
    InputError
        If the sizes do not match, or an array is not float64 or not finite.
    """

    coupling: Coupling = eqx.field(converter=as_coupling)
    prior: Prior
    noise: Covariance
    offset: DataVector | None = None

    def __check_init__(self):
        n_data, n_unknowns = self.coupling.shape
        if self.noise.size != n_data:
            raise InputError(
                f"the coupling matrix has {n_data} rows, the noise covariance {self.noise.size}; "
                "build both for the same observation and flags"
            )
        if self.prior.size != n_unknowns:
            why = f"A has {n_unknowns} columns, the prior {self.prior.size} unknowns; use one lmax"
            raise InputError(why)
        if self.offset is not None:
            require_array("the offset", self.offset, (n_data,))

    def description(self) -> tuple[str, ...]:
        offset = "" if self.offset is None else " + offset"
        return (
            f"d = A m{offset} + n, {self.n_data} data, {self.prior.size} unknowns of the sky, in K",
            f"A {type(self.coupling).__name__}, S {type(self.prior).__name__}, "
            f"N {type(self.noise).__name__}",
            "condition(data).posterior is the posterior of the sky",
        )

    @property
    def n_data(self) -> int:
        """Number of data."""
        return self.coupling.shape[0]

    def predict(self, sky: Float[Array, " unknowns"]) -> DataVector:
        """Predict the mean data of a sky, without noise.

        Parameters
        ----------
        sky : (unknowns,) array
            m, in K.

        Returns
        -------
        (data,) array
            A m + offset, in K.

        Raises
        ------
        InputError
            If ``sky`` is not float64 or has another length.
        """
        seen = self.coupling @ sky
        return seen if self.offset is None else seen + self.offset

    def chi2(self, sky: Float[Array, " unknowns"], data: DataVector) -> Float[Array, ""]:
        """Compute ``|L^-1 (d - A m - offset)|^2``, with N = L L^T.

        Parameters
        ----------
        sky : (unknowns,) array
            m, in K.
        data : (data,) array
            d, in K.

        Returns
        -------
        () array
            chi^2 of the residuals.

        Raises
        ------
        InputError
            If N is not positive definite, or the data have another shape.
        """
        require_shape("the data", data, (self.n_data,))
        white = self.noise.factor().whiten(data - self.predict(sky))
        return namespace(white).asarray(white @ white)

    def sample(self, key: PRNGKeyArray) -> tuple[Float[Array, " unknowns"], DataVector]:
        """Draw a sky from the prior, and data of that sky.

        Parameters
        ----------
        key : PRNGKeyArray
            Random key.

        Returns
        -------
        (unknowns,) array
            m, in K.
        (data,) array
            d, in K.

        Raises
        ------
        InputError
            If N is not positive definite.
        """
        sky_key, noise_key = jax.random.split(key)
        sky = self.prior.sample(sky_key)
        return sky, self.predict(sky) + self.noise.sample(noise_key)

    def factorise(self, form: type[Whitened] | None = None) -> Whitened:
        """Precompute everything that does not depend on the data, to condition on many of them.

        Works inside JAX's transformations, as do the solver's methods.

        Parameters
        ----------
        form : {InMap, InData}, optional
            By default the smaller one.

        Returns
        -------
        Whitened
            The factorised model.

        Raises
        ------
        InputError
            If N is not positive definite, or Lambda cannot be factorised.
        """
        return (form or form_of(self, transformed=True)).of(self)

    def condition(self, data: DataVector, form: type[Form] | None = None) -> Solution:
        """Solve the model for data.

        Parameters
        ----------
        data : (data,) array
            d, in K.
        form : {FromInformation, InMap, InData}, optional
            By default that of :func:`form_of`.

        Returns
        -------
        Solution
            With the posterior over the sky, and the information in the data.

        Raises
        ------
        InputError
            If the data are not float64, not finite or of another length, the model cannot be
            factorised, or the mean does not converge.
        """
        traced = is_traced(*jax.tree.leaves((self, data)))
        return (form or form_of(self, transformed=traced)).of(self).condition(data)

    def log_prob(self, data: DataVector) -> Float[Array, ""]:
        """Compute the evidence ln p(d), with the sky integrated out. Differentiable.

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
        return self.factorise().log_prob(data)


@dataclass(frozen=True, repr=False)
class Solution(Described):
    """A model solved for data, in NumPy's arrays except inside JAX's transformations.

    Attributes
    ----------
    model : LinearGaussian
        The model.
    data : (data,) array
        d, in K.
    posterior : Posterior
        Over the sky, with the evidence of the data.
    factor : Factor
        L of N = L L^T.
    kept_information : Information or None
        :attr:`information` without the excess, if the posterior was computed from it.
    excess : float
        Excess of chi^2 if prior means of unknowns in N are shifted, to make up for volume.
    """

    model: LinearGaussian
    data: DataVector
    posterior: Posterior
    factor: Factor
    kept_information: of_data.Information | None = None
    excess: float = 0.0

    def description(self) -> tuple[str, ...]:
        return (*self.posterior.description(), "posterior, information, covariance, under(prior)")

    @cached_property
    def information(self) -> of_data.Information:
        """ln p(d | m) as a function of the sky; only its reference depends on the prior."""
        if (kept := self.kept_information) is None:
            kept = FromInformation.of(self.model).condition(self.data).kept_information
        return replace(kept, misfit=np.asarray(kept.misfit - self.excess))

    @property
    def matrix(self) -> ModesMatrix | None:
        """A^T N^-1 A, if it has been computed."""
        return None if self.kept_information is None else self.kept_information.matrix

    @cached_property
    def covariance(self) -> Float[Array, "unknowns unknowns"]:
        """C of the posterior, in K^2."""
        return self.posterior.covariance()

    @cached_property
    def chi2(self) -> float:
        """chi^2 of the data under the model: (d - E[d])^T (A S A^T + N)^-1 (d - E[d])."""
        white = self.factor.whiten(self.data - self.model.predict(self.posterior.mean))
        return float(white @ white + self.posterior.prior_chi2()) - self.excess

    def weighted_residual(self) -> DataVector:
        """Compute N^-1 (d - offset - A m), where m is the posterior mean of the sky.

        Multiplied by T^T, it gives the mean of templates' amplitudes; multiplied by a term N_0 of
        N, the mean of this term's part of the data.
        """
        return np.asarray(self.factor.solve(self.data - self.model.predict(self.posterior.mean)))

    def less(self, excess: float) -> Solution:
        """The same, with chi^2 and -2 ln p(d) lower by a number."""
        evidence = np.asarray(self.posterior.log_evidence + excess / 2.0)
        posterior = replace(self.posterior, log_evidence=evidence)
        return replace(self, posterior=posterior, excess=excess)

    def under(self, prior: Prior) -> Solution:
        """Solve for the same data under another prior; A^T N^-1 A is not computed again.

        Parameters
        ----------
        prior : Prior
            Over the same unknowns.

        Raises
        ------
        InputError
            As :meth:`LinearGaussian.condition`.
        """
        model = replace(self.model, prior=prior)
        if form_of(model) is not FromInformation:
            return model.condition(self.data)
        return FromInformation.of(model, self.information.matrix, self.factor).condition(self.data)


def form_of(model: LinearGaussian, *, transformed: bool = False) -> type[Form]:
    """Choose the form in which to solve a model.

    Parameters
    ----------
    model : LinearGaussian
        The model.
    transformed : bool
        Inside JAX's transformations, such as ``grad`` or ``vmap``, which need a form in JAX.

    Returns
    -------
    type
        The cheapest applicable form.
    """
    if model.n_data < model.prior.size:
        return InData
    return InMap if transformed else FromInformation


class Form(eqx.Module):
    """A factorised model: solving it for data costs a few products.

    Attributes
    ----------
    model : LinearGaussian
        The model.
    factor : Factor
        L of N = L L^T.
    """

    model: LinearGaussian
    factor: Factor

    @classmethod
    @abstractmethod
    def of(cls, model: LinearGaussian) -> Form:
        """Factorise a model.

        Raises
        ------
        InputError
            If N is not positive definite, or Lambda cannot be factorised.
        """

    @abstractmethod
    def condition(self, data: DataVector) -> Solution:
        """Solve for data.

        Parameters
        ----------
        data : (data,) array
            d, in K.

        Raises
        ------
        InputError
            If the data are not float64, not finite or of another length, or the refinement of the
            mean does not converge.
        """

    def log_prob(self, data: DataVector) -> Float[Array, ""]:
        """Compute the evidence ln p(d) of data in K; errors are those of :meth:`condition`."""
        return self.condition(data).posterior.log_evidence


# relative difference between two computations of the same A, and acceptable rounding of Lambda,
# whose eigenvalues are 1 or more
SAME, SEEN_ROUNDING = 1e-9, 1e-4


class FromInformation(Form):
    """Solution from A^T N^-1 A in NumPy; not for use inside JAX's transformations.

    Attributes
    ----------
    coupling : Coupling
        A: dense, unless A and N have structure in time.
    matrix : (modes, modes) array
        A^T N^-1 A, in 1/K^2.
    lower : (modes, modes) array
        Cholesky factor of Lambda.
    """

    coupling: Coupling
    matrix: ModesMatrix
    lower: ModesMatrix

    @classmethod
    def of(
        cls, model: LinearGaussian, matrix: ModesMatrix | None = None, factor: Factor | None = None
    ) -> FromInformation:
        """Factorise a model; A^T N^-1 A and L of N can be given."""
        model = on_host(model)
        coupling = model.coupling
        factor = model.noise.factor() if factor is None else factor
        if not has_structure(coupling, model.noise):
            coupling = DenseCoupling(coupling.dense())
        if matrix is None:
            matrix = normal_matrix(coupling, model.noise, factor)
        return cls(model, factor, coupling, matrix, of_data.precision_root(matrix, model.prior))

    @classmethod
    def beside(cls, solution: Solution, model: LinearGaussian) -> FromInformation:
        """Factorise a model with the S and N_0 of a solved one, but another U.

        With N = N_0 + U U^T, and V and R of :class:`.LowRankFactor`, ::

            A^T N^-1 A = A^T N_0^-1 A - (R^-1 V^T L_0^-1 A)^T (R^-1 V^T L_0^-1 A),

        unless there is no U, A differs, too, or rounding of the first term would affect Lambda.
        """
        host, old = on_host(model), solution.factor
        if not isinstance(host.noise, LowRankUpdate):
            return cls.of(model)
        base = old.base if isinstance(old, LowRankFactor) else old
        factor, matrix = host.noise.factor(base), solution.matrix
        largest = (np.asarray(solution.posterior.lower) ** 2).sum(1).max()
        for sign, one in ((1.0, old), (-1.0, factor)):
            if isinstance(one, LowRankFactor):
                pull = host.coupling.transpose_mv(np.asarray(base.whiten_transpose(one.v)))
                half = solve_lower(np.asarray(one.lower), pull.T, transpose=False)
                matrix = matrix + sign * gram_matrix(half)
                largest = max(largest, (host.prior.colour_columns(half) ** 2).sum(0).max())
        sky = solution.posterior.mean
        seen, before = (np.asarray(one.coupling @ sky) for one in (host, solution.model))
        another = np.abs(seen - before).max() > SAME * np.abs(seen).max()
        if another or largest * np.finfo(np.float64).eps > SEEN_ROUNDING:
            return cls.of(model)
        return cls(host, factor, host.coupling, matrix, of_data.precision_root(matrix, host.prior))

    def condition(self, data: DataVector) -> Solution:
        require_array("the data", data, (self.model.n_data,))
        data, prior = np.array(data), self.model.prior
        u, _, _ = self.about(data, np.zeros(prior.size)).white_mean(prior, self.lower, most=1)
        information = self.about(data, prior.colour(u))
        posterior = information.posterior(prior, self.lower)
        return Solution(self.model, data, posterior, self.factor, information)

    def about(self, data: DataVector, sky: Modes) -> of_data.Information:
        """Information of data, about a reference sky in K."""
        offset, n = self.model.offset, self.model.n_data
        white = self.factor.whiten(data - (0.0 if offset is None else offset) - self.coupling @ sky)
        vector = self.coupling.transpose_mv(np.asarray(self.factor.whiten_transpose(white)))
        scalars = map(np.asarray, (white @ white, self.factor.log_det(), float(n)))
        return of_data.Information(self.matrix, np.asarray(vector), sky, *scalars)


class Whitened(Form):
    """Solution from W = L^-1 A G in JAX: differentiable, and usable in JAX's transformations.

    Attributes
    ----------
    whitened : (data, white) array
        W; in map space L^-1 A.
    lower : (rank, rank) array
        Cholesky factor of Lambda, or of Lambda_v if ``basis`` is given.
    basis : (white, rank) array or None
        Q of the data-space form; None in map space.
    """

    whitened: Float[Array, "data white"]
    lower: Float[Array, "rank rank"]
    basis: Float[Array, "white rank"] | None

    @classmethod
    def of(cls, model: LinearGaussian) -> Whitened:
        solver = cls(model, *cls._factorised(model))
        if not is_traced(solver.lower) and not np.isfinite(np.diagonal(solver.lower)).all():
            model.noise.factor()  # outside jit: raises and names the term that is not positive
            wrong = "Lambda has no Cholesky factor: the data are too precise; use form=InData"
            raise InputError(wrong)
        return solver

    @staticmethod
    @abstractmethod
    def _factorised(model: LinearGaussian) -> tuple[Factor, Array, Array, Array | None]:
        """L of N, W, L of Lambda, and the basis."""

    def _log_det(self) -> Float[Array, ""]:
        """ln|Lambda|."""
        return 2.0 * jnp.log(jnp.diagonal(self.lower)).sum()

    def seen(self, u: Float[Array, " white"]) -> DataVector:
        """Compute W u."""
        return self.whitened @ u

    def condition(self, data: DataVector) -> Solution:
        require_array("the data", data, (self.model.n_data,))
        data = jnp.array(data)
        u, log_evidence, moved = _solve(self, data)
        if not is_traced(moved) and not float(moved) <= of_data.CONVERGENCE:
            raise InputError(
                f"the posterior mean did not converge: after {of_data.MAX_REFINEMENTS} refinements "
                f"it still changes by {float(moved):.2g} standard deviations (accepted: "
                f"{of_data.CONVERGENCE:g}); the noise is too small for float64 arithmetic"
            )
        posterior = Posterior(self.model.prior, u, self.lower, self.basis, log_evidence, moved)
        parts = self.model, data, posterior, self.factor
        # if the evidence is differentiated outside of jit, the last step alone is not traced
        return Solution(*(parts if is_traced(*jax.tree.leaves(parts)) else on_host(parts)))


class InMap(Whitened):
    """Map-space form, which colours only a square: Lambda = 1 + G^T (A^T N^-1 A) G."""

    @staticmethod
    @eqx.filter_jit
    def _factorised(model):
        factor = model.noise.factor()
        whitened = factor.whiten(model.coupling.dense())
        lower = root_of_precision(model.prior.sandwich(gram_matrix(whitened)))
        return factor, whitened, lower, None

    def seen(self, u):
        return self.whitened @ self.model.prior.colour(u)


class InData(Whitened):
    """Data-space form: Lambda_v = 1 + R R^T, with W^T = Q R."""

    @staticmethod
    @eqx.filter_jit
    def _factorised(model):
        factor = model.noise.factor()
        whitened = factor.whiten(model.prior.colour_columns(model.coupling.dense()))
        basis, triangle = jnp.linalg.qr(jax.lax.stop_gradient(whitened).T)
        return factor, whitened, root_of_precision(triangle @ triangle.T), basis

    def _log_det(self):
        return _log_det_in_span(self.whitened, jax.lax.stop_gradient(self.lower))


def root_of_precision(normal: Array) -> Array:
    """Lower L of L L^T = 1 + G^T (A^T N^-1 A) G, in JAX; NaN if there is none."""
    return jax.lax.linalg.cholesky(normal + jnp.eye(len(normal)), symmetrize_input=False)


@jax.custom_jvp
def _log_det_in_span(whitened: Array, lower: Array) -> Array:
    """ln|1 + W W^T| from the data-space form, whose QR has no derivative at low rank."""
    return 2.0 * jnp.log(jnp.diagonal(lower)).sum()


@_log_det_in_span.defjvp
def _log_det_in_span_jvp(primals, tangents):
    """d ln|1 + W W^T| = 2 sum( (1 + W W^T)^-1 W * dW )."""
    whitened, lower = primals
    gram_of_data = jnp.eye(whitened.shape[0]) + whitened @ whitened.T
    slope = jax.scipy.linalg.cho_solve((jnp.linalg.cholesky(gram_of_data), True), whitened)
    return _log_det_in_span(whitened, lower), 2.0 * (slope * tangents[0]).sum()


def _newton(solver: Whitened, white: Array, u: Array) -> tuple[Array, Array]:
    """u plus Lambda^-1 (W^T (w - W u) - u), and the length of that step in standard deviations."""
    lower, basis = solver.lower, solver.basis
    (pulled,) = jax.linear_transpose(solver.seen, u)(white - solver.seen(u))
    gradient = pulled - u
    projected = gradient if basis is None else basis.T @ gradient
    half = solve_lower(lower, projected[:, None], transpose=False)
    step = solve_lower(lower, half, transpose=True)[:, 0]
    if basis is not None:
        # outside the span of W^T, Lambda is 1 and the gradient is zero except for rounding; it is
        # kept only in derivatives
        outside = gradient - basis @ projected
        step = basis @ step + (outside - jax.lax.stop_gradient(outside))
    return u + step, jnp.linalg.norm(half)


@eqx.filter_jit
def _solve(solver: Whitened, data: DataVector) -> tuple[Array, Array, Array]:
    """Mean of u, log evidence, and size of the last refinement in standard deviations.

    The normal equations square the condition number; repeating the solve on the residual
    (corrected seminormal equations) restores the lost digits. Derivatives do not pass through the
    iteration: one more step with live arrays at its fixed point carries them exactly.
    """
    # L^-1 (d - E[d]), where E[d] is the prediction of the prior's mean sky
    offset, expected = solver.model.offset, solver.model.prior.white_mean
    white = solver.factor.whiten(data if offset is None else data - offset) - solver.seen(expected)
    frozen, still = jax.lax.stop_gradient((solver, white))

    def refine(state):
        u, moved = _newton(frozen, still, state[0])
        return u, moved, state[1], state[3] + 1

    first, _ = _newton(frozen, still, jnp.zeros(solver.whitened.shape[1]))
    start = (first, jnp.inf, jnp.inf, 0)
    u, moved, _, _ = jax.lax.while_loop(lambda state: of_data.unfinished(*state[1:]), refine, start)
    fixed = replace(solver, lower=frozen.lower, basis=frozen.basis)
    u, _ = _newton(fixed, white, jax.lax.stop_gradient(u))
    misfit = white - solver.seen(u)
    log_evidence = -0.5 * (
        misfit @ misfit
        + u @ u
        + solver.factor.log_det()
        + solver._log_det()
        + white.shape[0] * np.log(2.0 * np.pi)
    )
    # so far, u was the sky's deviation from the prior's mean
    return u + expected, log_evidence, moved
