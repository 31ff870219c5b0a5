"""What data say of the sky: their log-likelihood as a quadratic form.

::

    ln p(d | m) = -1/2 [ chi^2 - 2 v.(m - m0) + (m - m0)^T M (m - m0) + ln|N| + N_data ln 2 pi ],
    M = A^T N^-1 A,    v = A^T N^-1 (d - A m0 - offset),    chi^2 = |L^-1 (d - A m0 - offset)|^2

for any reference sky m0. It has the size of the sky, however many data there are. With a prior it
gives the posterior, with those of other frequencies a joint one. m0 is chosen near the posterior
mean: for m0 = 0 the terms are 1e10 times larger than their sum. Unknowns that are
of no interest are integrated out.
"""

from __future__ import annotations

from dataclasses import replace

import equinox as eqx
import numpy as np
from jaxtyping import Float

from lusee_bayes.core.arrays import (
    Array,
    DataVector,
    Modes,
    ModesMatrix,
    compiled,
    namespace,
    on_processor,
    placed,
    repeated,
)
from lusee_bayes.core.checks import Described, is_traced, number, require_array, require_shape
from lusee_bayes.core.errors import InputError
from lusee_bayes.core.linalg import cholesky, gram_matrix, precise_residual, scaled, solve_lower
from lusee_bayes.core.trees import quantity
from lusee_bayes.instrument.coupling import Coupling, DenseCoupling
from lusee_bayes.linear.normal_matrix import has_structure, is_within_times, normal_matrix
from lusee_bayes.linear.posterior import Posterior
from lusee_bayes.linear.solver import CONVERGENCE, MAX_REFINEMENTS, unfinished
from lusee_bayes.noise.covariance import Covariance, Factor
from lusee_bayes.sky.prior import Prior


class Information(Described, eqx.Module):
    """ln p(d | m) of some data as a function of the sky m; see the module's equations.

    Attributes
    ----------
    matrix : (modes, modes) array
        M = A^T N^-1 A, in 1/K^2.
    vector : (modes,) array
        v, the gradient of ln p(d | m) at the reference sky, in 1/K.
    reference : (modes,) array
        The reference sky m0, in K.
    misfit : () array
        chi^2 of the reference sky.
    log_det : () array
        ln|N|, with N in K^2.
    n_data : () array
        Number of data, as a float.
    """

    matrix: ModesMatrix = quantity("K-2", "A^T N^-1 A")
    vector: Modes = quantity("K-1", "A^T N^-1 (d - A reference)")
    reference: Modes = quantity("K", "reference sky")
    misfit: Float[Array, ""] = quantity("1", "chi^2 at the reference sky")
    log_det: Float[Array, ""] = quantity("1", "ln det N")
    n_data: Float[Array, ""] = quantity("1", "number of data")

    @classmethod
    def of(
        cls,
        coupling: Coupling,
        prior: Prior,
        noise: Covariance,
        offset: DataVector | None,
        data: DataVector,
        known: Information | None = None,
    ) -> tuple[Information, Posterior]:
        """Compute the information of data, and the posterior under a prior.

        A is not formed where N has structure in time.

        Parameters
        ----------
        coupling : Coupling
            A, of shape (data, modes).
        prior : Prior
            Over the same modes. Its posterior mean becomes the reference sky.
        noise : Covariance
            N, in K^2.
        offset : (data,) array or None
            Mean of the data without a sky, in K; None for zero.
        data : (data,) array
            d, in K.
        known : Information, optional
            Of the same data under the same A and N, with any reference sky.

        Returns
        -------
        Information
            Of these data; only its reference sky depends on the prior.
        Posterior
            Under the prior.

        Raises
        ------
        InputError
            If ``data`` is not float64, not finite or of another length, N is not positive definite,
            the prior is over pixels, or the mean does not converge.
        """
        require_array("the data", data, (noise.size,))
        if is_within_times(noise):
            coupling, prior, noise, offset, data = on_processor(
                (coupling, prior, noise, offset, data)
            )
        factor = noise.factor()
        structured = has_structure(coupling, noise)
        if not structured:
            coupling = DenseCoupling(coupling.dense())
        xp = namespace((coupling, noise, data))
        centred = xp.asarray(data) if offset is None else data - offset
        first = known
        if first is None:
            if structured:
                matrix = normal_matrix(coupling, noise)
            else:
                matrix = gram_matrix(factor.whiten(coupling.dense()))
            zero, n_data = xp.zeros(prior.size), xp.asarray(float(noise.size))
            vector, misfit = gradient_and_misfit(coupling, factor, centred, zero)
            first = cls(matrix, vector, zero, misfit, xp.asarray(factor.log_det()), n_data)
        _require_modes(prior, first.n_modes)
        lower = _precision_root(first.matrix, prior)
        mean = prior.colour(_condition(first, prior, lower, 1)[0])
        vector, misfit = gradient_and_misfit(coupling, factor, centred, mean)
        information = replace(first, vector=vector, reference=mean, misfit=misfit)
        return information, information._posterior(prior, lower)

    def description(self) -> tuple[str, ...]:
        return (
            f"ln p(d | m) of {number(self.n_data, '.0f')} data, for {self.n_modes} modes of the "
            "sky, in K",
        )

    @property
    def n_modes(self) -> int:
        """Number of modes of the sky."""
        return self.reference.shape[0]

    def recentred(self, sky: Modes) -> Information:
        """Write the same function with another reference sky.

        Parameters
        ----------
        sky : (modes,) array
            The new reference sky, in K.

        Returns
        -------
        Information
            With the same values for every sky.

        Raises
        ------
        InputError
            If ``sky`` has another length.
        """
        require_shape("the sky", sky, (self.n_modes,))
        shift = sky - self.reference
        pulled = self.matrix @ shift
        misfit = self.misfit - 2.0 * (self.vector @ shift) + shift @ pulled
        misfit = namespace(misfit).asarray(misfit)
        return replace(self, vector=self.vector - pulled, reference=sky, misfit=misfit)

    def __add__(self, other: Information) -> Information:
        """The information of the data of both, whose noise is independent.

        Parameters
        ----------
        other : Information
            Of other data, for the same modes.

        Raises
        ------
        InputError
            If it is for another number of modes.
        """
        require_shape("the other reference sky", other.reference, (self.n_modes,))
        here, xp = other.recentred(self.reference), namespace(self.matrix)
        return Information(
            self.matrix + here.matrix,
            self.vector + here.vector,
            self.reference,
            *(
                xp.asarray(getattr(self, name) + getattr(here, name))
                for name in ("misfit", "log_det", "n_data")
            ),
        )

    def raised(self, factor: float) -> Information:
        """The information of the same data under N times a factor.

        Parameters
        ----------
        factor : float
            Of N, positive.
        """
        if factor == 1.0:
            return self
        xp = namespace(self.matrix)
        return replace(
            self,
            matrix=self.matrix / factor,
            vector=self.vector / factor,
            misfit=xp.asarray(self.misfit / factor),
            log_det=xp.asarray(self.log_det + self.n_data * np.log(factor)),
        )

    def chi2(self, sky: Modes) -> Float[Array, ""]:
        """Compute ``chi^2 = |L^-1 (d - A m - offset)|^2`` of a sky.

        Parameters
        ----------
        sky : (modes,) array
            m, in K.

        Returns
        -------
        () array
            chi^2.

        Raises
        ------
        InputError
            If ``sky`` has another length.
        """
        return self.recentred(sky).misfit

    def fit(self, mean: Modes, covariance: ModesMatrix) -> dict[str, float]:
        """Compute chi^2 of the residuals about a mean, and its expectation if the model holds.

        Parameters
        ----------
        mean, covariance : (modes,) and (modes, modes) array
            Of the posterior, which may be given other data, too, in K and K^2.

        Returns
        -------
        dict of float
            ``chi2``, and ``chi2_expected``: N_data - tr(M C).
        """
        expected = float(self.n_data - np.vdot(self.matrix, covariance))
        return {"chi2": float(self.chi2(mean)), "chi2_expected": expected}

    def log_likelihood(self, skies: Float[Array, "n modes"]) -> Float[np.ndarray, " n"]:
        """Compute ln p(d | m) of some skies.

        Parameters
        ----------
        skies : (n, modes) array
            m, in K.

        Returns
        -------
        (n,) array
            For data in K.
        """
        rest = float(self.log_det + self.n_data * np.log(2.0 * np.pi))
        return np.array([-0.5 * (float(self.chi2(sky)) + rest) for sky in skies])

    def posterior(self, prior: Prior) -> Posterior:
        """Compute the posterior over the sky.

        Parameters
        ----------
        prior : Prior
            Over the same modes.

        Returns
        -------
        Posterior
            With the evidence of the data.

        Raises
        ------
        InputError
            If the prior is over pixels or has another size, or the mean does not converge.
        """
        _require_modes(prior, self.n_modes)
        return self._posterior(prior, _precision_root(self.matrix, prior))

    def _posterior(self, prior: Prior, lower: Array) -> Posterior:
        u, log_evidence, moved = _condition(self, prior, lower, MAX_REFINEMENTS)
        if not is_traced(moved) and not float(moved) <= CONVERGENCE:
            # m0 is far from the mean, so that the gradient is the small difference of large numbers
            u, log_evidence, moved = _condition(self, prior, lower, MAX_REFINEMENTS, precise=True)
        # rounding grows with u, which is of order one where the data are what the prior allows
        if not is_traced(moved) and not float(moved) <= (
            accepted := CONVERGENCE * max(1.0, float(np.sqrt(np.mean(np.square(u)))))
        ):
            raise InputError(
                f"the posterior mean did not converge: its last step was {float(moved):.2g} "
                f"standard deviations (accepted: {accepted:.2g}); the data are too precise for "
                "the normal equations, or far from anything that the prior allows"
            )
        return Posterior(prior, u, lower, None, log_evidence, moved)


def _require_modes(prior: Prior, n_modes: int) -> None:
    if not prior.invertible or prior.size != n_modes:
        raise InputError(
            f"information about {n_modes} modes needs a prior over the same modes, got "
            f"{type(prior).__name__} over {prior.size} unknowns"
        )


@compiled
def gradient_and_misfit(
    coupling: Coupling, factor: Factor, data: Array, sky: Array
) -> tuple[Array, Array]:
    """Return A^T N^-1 (d - A m) and ``|L^-1 (d - A m)|^2``."""
    white = factor.whiten(data - coupling @ sky)
    solved = factor.whiten_transpose(white)
    return coupling.transpose_mv(solved), namespace(white).asarray(white @ white)


@compiled
def _precision_root(matrix: ModesMatrix, prior: Prior) -> Array:
    """L of the precision 1 + G^T M G of u = G^-1 m."""
    precision = prior.sandwich(matrix)
    diagonal = np.diag_indices(len(precision))
    return cholesky(placed(precision, diagonal, precision[diagonal] + 1.0), overwrite=True)


@compiled
def _condition(
    information: Information, prior: Prior, lower: Array, refinements: int, *, precise: bool = False
) -> tuple[Array, Array, Array]:
    """Mean of u, ln p(d), and the last step in standard deviations.

    u is found as a correction to that of m0; components without prior power are zero. The solution
    is repeated on what is left of the gradient, up to so many times, as long as that gains.
    """
    xp = namespace(information)
    start = prior.whiten(information.reference)
    mean = prior.white_mean
    expected = xp.zeros_like(start) if mean is None else mean
    here = information.recentred(prior.colour(start))

    def refine(state):
        correction, before, _, count = state
        shift = prior.colour(correction)
        if precise:
            pull = precise_residual(here.vector, here.matrix, shift)
        else:
            pull = here.vector - here.matrix @ shift
        gradient = prior.colour_columns(pull[None])[0] - (start + correction - expected)
        half = solve_lower(lower, gradient[:, None], transpose=False)
        step = solve_lower(lower, half, transpose=True)[:, 0]
        return correction + step, xp.asarray(xp.linalg.norm(half)), before, count + 1

    never = xp.asarray(np.inf)
    first = (xp.zeros_like(start), never, never, xp.asarray(0))
    correction, moved, _, _ = repeated(xp, unfinished(refinements), refine, first)
    u = start + correction
    log_evidence = -0.5 * (
        here.recentred(prior.colour(u)).misfit
        + (u - expected) @ (u - expected)
        + here.log_det
        + 2.0 * xp.log(xp.diagonal(lower)).sum()
        + here.n_data * np.log(2.0 * np.pi)
    )
    return u, xp.asarray(log_evidence), moved


def integrated_out(
    information: Information, n: int, variance: Float[Array, " others"]
) -> Information:
    """Write ln p(d) as a function of the first unknowns, the others integrated out.

    With b ~ N(0, D) for the others, and K = M_bb + D^-1, ::

        M' = M_aa - M_ab K^-1 M_ba,    v' = v_a - M_ab K^-1 v_b

    Parameters
    ----------
    information : Information
        Of all unknowns.
    n : int
        How many unknowns are kept.
    variance : (others,) array
        D of the others, in K^2, positive.

    Returns
    -------
    Information
        Of n unknowns.

    Raises
    ------
    InputError
        If ``variance`` has another length.
    """
    others = information.n_modes - n
    require_shape("the variance", variance, (others,))
    xp = namespace(information)
    here = information.recentred(xp.concatenate([information.reference[:n], xp.zeros(others)]))
    scale = xp.sqrt(variance)
    lower = cholesky(scaled(here.matrix[n:, n:], scale) + xp.eye(others))
    across = solve_lower(lower, scale[:, None] * here.matrix[n:, :n], transpose=False)
    pull = solve_lower(lower, (scale * here.vector[n:])[:, None], transpose=False)
    return Information(
        here.matrix[:n, :n] - across.T @ across,
        here.vector[:n] - (across.T @ pull)[:, 0],
        here.reference[:n],
        xp.asarray(here.misfit - (pull**2).sum()),
        xp.asarray(here.log_det + 2.0 * xp.log(xp.diagonal(lower)).sum()),
        here.n_data,
    )
