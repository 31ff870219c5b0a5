"""The data's information about the sky: their log-likelihood as a quadratic form.

::

    ln p(d | m) = -1/2 [ chi^2 - 2 v.(m - m0) + (m - m0)^T M (m - m0) + ln|N| + N_data ln 2 pi ],
    M = A^T N^-1 A,    v = A^T N^-1 (d - A m0 - offset),    chi^2 = |L^-1 (d - A m0 - offset)|^2

for any reference sky m0. Its size is the sky's, independent of the number of data. With a prior it
gives the posterior; with the information of other frequencies, a joint posterior. m0 is chosen near
the posterior mean: for m0 = 0 the terms are 1e10 times larger than their sum. Unknowns of no
interest are integrated out.

All of this runs in NumPy; nothing here is differentiated or traced.
"""

from __future__ import annotations

from dataclasses import replace

import equinox as eqx
import numpy as np
from jaxtyping import Float

from lusee_bayes.core import checks, linalg, trees
from lusee_bayes.core.arrays import Array, Modes, ModesMatrix, on_host
from lusee_bayes.core.errors import InputError
from lusee_bayes.linear.posterior import Posterior
from lusee_bayes.sky.prior import Prior

# a mean is accepted when its last refinement moved no coefficient of u by more than this many
# posterior standard deviations
CONVERGENCE = 1e-6
MAX_REFINEMENTS = 10


def unfinished(
    moved: float | Array, before: float | Array, count: int | Array, most: int = MAX_REFINEMENTS
) -> bool | Array:
    """Whether to refine a mean once more, after ``count`` of at most ``most`` steps.

    ``moved`` and ``before`` are the lengths of the last step and the one before.
    """
    # the remainder may be rounding, which no refinement reduces
    gains = (moved >= CONVERGENCE) | (moved <= 0.5 * before)
    return (count < 1) | ((moved > 1e-3 * CONVERGENCE) & gains & (count < most))


class Information(checks.Described, eqx.Module):
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

    matrix: ModesMatrix = trees.quantity("K-2", "A^T N^-1 A")
    vector: Modes = trees.quantity("K-1", "A^T N^-1 (d - A reference)")
    reference: Modes = trees.quantity("K", "reference sky")
    misfit: Float[Array, ""] = trees.quantity("1", "chi2 at the reference sky")
    log_det: Float[Array, ""] = trees.quantity("1", "ln det N")
    n_data: Float[Array, ""] = trees.quantity("1", "number of data")

    def description(self) -> tuple[str, ...]:
        return (
            f"ln p(d | m) of {checks.number(self.n_data, '.0f')} data, for {self.n_modes} sky "
            "modes, in K",
        )

    @property
    def n_modes(self) -> int:
        """Number of modes of the sky."""
        return self.reference.shape[0]

    def recentred(self, sky: Modes) -> Information:
        """Express the same function about another reference sky.

        Parameters
        ----------
        sky : (modes,) array
            The new reference sky, in K.

        Returns
        -------
        Information
            With the same value for every sky.

        Raises
        ------
        InputError
            If ``sky`` has another length.
        """
        checks.require_shape("the sky", sky, (self.n_modes,))
        shift = sky - self.reference
        pulled = self.matrix @ shift
        misfit = np.asarray(self.misfit - 2.0 * (self.vector @ shift) + shift @ pulled)
        return replace(self, vector=self.vector - pulled, reference=sky, misfit=misfit)

    def __add__(self, other: Information) -> Information:
        """Add the information of other data with independent noise.

        Parameters
        ----------
        other : Information
            Of other data, for the same modes.

        Raises
        ------
        InputError
            If it is for another number of modes.
        """
        what = "the sky of the other data (use one lmax and noise.above_lmax for all)"
        checks.require_shape(what, other.reference, (self.n_modes,))
        moved = other.recentred(self.reference)
        names = ("matrix", "vector", "misfit", "log_det", "n_data")
        return self.altered(**{name: getattr(self, name) + getattr(moved, name) for name in names})

    def raised(self, factor: float) -> Information:
        """Information of the same data with N multiplied by a factor.

        Parameters
        ----------
        factor : float
            Of N, positive.
        """
        shares = {name: getattr(self, name) / factor for name in ("matrix", "vector", "misfit")}
        return self.altered(**shares, log_det=self.log_det + self.n_data * np.log(factor))

    def altered(self, **numbers: float | Array) -> Information:
        """Return the information with these attributes, as NumPy arrays."""
        return replace(self, **{name: np.asarray(value) for name, value in numbers.items()})

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
        """Compute chi^2 of the residuals about a mean, and its expectation under the model.

        Parameters
        ----------
        mean, covariance : (modes,) and (modes, modes) array
            Of the posterior, which may include other data, in K and K^2.

        Returns
        -------
        dict of float
            ``chi2``, and ``chi2_expected``: N_data - tr(M C).
        """
        expected = float(self.n_data - np.vdot(self.matrix, covariance))
        return {"chi2": float(self.chi2(mean)), "chi2_expected": expected}

    def log_likelihood(self, skies: Float[Array, "n modes"]) -> Float[np.ndarray, " n"]:
        """Compute ln p(d | m) for several skies.

        Parameters
        ----------
        skies : (n, modes) array
            m, in K.

        Returns
        -------
        (n,) array
            For data in K.
        """
        shifts = skies - self.reference
        chi2 = self.misfit + (shifts * (shifts @ self.matrix - 2.0 * self.vector)).sum(1)
        return -0.5 * (chi2 + self.log_det + self.n_data * np.log(2.0 * np.pi))

    def posterior(self, prior: Prior, lower: ModesMatrix | None = None) -> Posterior:
        """Compute the posterior over the sky.

        Parameters
        ----------
        prior : Prior
            Over the same modes.
        lower : (modes, modes) array, optional
            :func:`precision_root` under this prior, if it has been computed.

        Returns
        -------
        Posterior
            With the evidence of the data.

        Raises
        ------
        InputError
            If the prior has another size, or the mean does not converge.
        """
        prior = on_host(prior)
        lower = precision_root(self.matrix, prior) if lower is None else lower
        u, log_evidence, moved = self.white_mean(prior, lower)
        if not moved <= CONVERGENCE:
            # m0 is far from the mean, and the gradient a small difference of large numbers
            u, log_evidence, moved = self.white_mean(prior, lower, precise=True)
        # rounding grows with u, which is of order one if the data are plausible under the prior
        accepted = CONVERGENCE * max(1.0, float(np.sqrt(np.mean(np.square(u)))))
        if not moved <= accepted:
            raise InputError(
                f"the posterior mean did not converge: last step {moved:.2g} standard deviations "
                f"(accepted: {accepted:.2g}); data are too precise, or far outside the prior"
            )
        return Posterior(prior, u, lower, None, np.asarray(log_evidence), np.asarray(moved))

    def white_mean(
        self,
        prior: Prior,
        lower: ModesMatrix,
        most: int = MAX_REFINEMENTS,
        *,
        precise: bool = False,
    ) -> tuple[Modes, float, float]:
        """Compute the mean of u = G^-1 m.

        It is computed as a correction to u of m0; components without prior power are zero. The
        solution is repeated on the remaining gradient, as long as that improves it.

        Parameters
        ----------
        prior : Prior
            Over the same modes, in NumPy's arrays.
        lower : (modes, modes) array
            :func:`precision_root` under this prior.
        most : int
            Maximum number of solutions.
        precise : bool
            Compute the gradient with more than the digits of float64.

        Returns
        -------
        u : (modes,) array
        log_evidence : float
            ln p(d).
        moved : float
            The last step, in posterior standard deviations.
        """
        start, expected = prior.whiten(self.reference), prior.white_mean
        local, correction = self.recentred(prior.colour(start)), np.zeros_like(start)
        moved, before, count = np.inf, np.inf, 0
        while unfinished(moved, before, count, most):
            shift = prior.colour(correction)
            if precise:
                pull = linalg.precise_residual(local.vector, local.matrix, shift)
            else:
                pull = local.vector - local.matrix @ shift
            gradient = prior.colour_columns(pull[None])[0] - (start + correction - expected)
            half = linalg.solve_lower(lower, gradient[:, None], transpose=False)
            correction = correction + linalg.solve_lower(lower, half, transpose=True)[:, 0]
            moved, before, count = float(np.linalg.norm(half)), moved, count + 1
        u = start + correction
        log_evidence = -0.5 * (
            local.recentred(prior.colour(u)).misfit
            + (u - expected) @ (u - expected)
            + local.log_det
            + 2.0 * np.log(np.diagonal(lower)).sum()
            + local.n_data * np.log(2.0 * np.pi)
        )
        return u, float(log_evidence), moved


def precision_root(matrix: ModesMatrix, prior: Prior) -> ModesMatrix:
    """Compute L of the precision 1 + G^T M G of u = G^-1 m; NaN if there is none.

    Parameters
    ----------
    matrix : (modes, modes) array
        M, in 1/K^2.
    prior : Prior
        Over the same modes, in NumPy's arrays.

    Raises
    ------
    InputError
        If the prior has another size.
    """
    if prior.size != len(matrix):
        raise InputError(
            f"information about {len(matrix)} modes needs a prior over the same modes, got "
            f"{type(prior).__name__} over {prior.size} unknowns"
        )
    precision = prior.sandwich(matrix)
    precision[np.diag_indices_from(precision)] += 1.0
    return linalg.cholesky(precision, overwrite=True)


def integrated_out(
    information: Information, n: int, variance: Modes | ModesMatrix, mean: Modes | None = None
) -> Information:
    """Compute the information about the first unknowns, with the others integrated out.

    With b ~ N(mean, D) for the others, K = M_bb + D^-1, and v about that mean, ::

        M' = M_aa - M_ab K^-1 M_ba,    v' = v_a - M_ab K^-1 v_b

    Parameters
    ----------
    information : Information
        Of all unknowns.
    n : int
        Number of unknowns that are kept.
    variance : (others,) or (others, others) array
        D of the others, or its diagonal, in K^2, positive definite.
    mean : (others,) array, optional
        In K; by default zero.

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
    checks.require_shape("the variance", variance, (others,) * variance.ndim)
    mean = np.zeros(others) if mean is None else mean
    local = information.recentred(np.concatenate([information.reference[:n], mean]))
    inner, joined = local.matrix[n:, n:], np.c_[local.matrix[n:, :n], local.vector[n:]]
    if variance.ndim == 1:
        scale = np.sqrt(variance)
        inner, joined = linalg.scaled(inner, scale), scale[:, None] * joined
    else:
        root = linalg.checked_cholesky("the covariance of the others", variance)
        inner, joined = linalg.sandwich(inner, root), root.T @ joined
    lower = linalg.cholesky(inner + np.eye(others))
    solved = linalg.solve_lower(lower, joined, transpose=False)
    across, pull = solved[:, :n], solved[:, n:]
    misfit = np.asarray(local.misfit - (pull**2).sum())
    log_det = np.asarray(local.log_det + 2.0 * np.log(np.diagonal(lower)).sum())
    matrix = local.matrix[:n, :n] - across.T @ across
    vector = local.vector[:n] - (across.T @ pull)[:, 0]
    return Information(matrix, vector, local.reference[:n], misfit, log_det, local.n_data)
