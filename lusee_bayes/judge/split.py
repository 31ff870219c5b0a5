"""chi^2 of data in two parts: one that no sky explains, and one that tests the prior."""

from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from lusee_bayes.core.arrays import ModesMatrix
from lusee_bayes.core.errors import InputError
from lusee_bayes.core.linalg import cholesky, lower_triangle, solve_lower, times_lower
from lusee_bayes.judge.chi2 import ChiSquare
from lusee_bayes.judge.measures import expected_chi2
from lusee_bayes.linear.posterior import Posterior
from lusee_bayes.noise.covariance import log_det_of_lower

# k relative to the sky's strength in units of the prior
WIDER = 10.0


@dataclass(frozen=True)
class Split:
    """chi^2 of data in its two parts.

    Attributes
    ----------
    instrument : ChiSquare
        The part that no sky explains: it tests A and N.
    prior : ChiSquare
        The rest: it tests the prior, if A and N are correct.
    wide : Posterior
        Given the same data under the wide prior.
    """

    instrument: ChiSquare
    prior: ChiSquare
    wide: Posterior

    @classmethod
    def of(
        cls, posterior: Posterior, chi2: float, n_data: int, matrix: ModesMatrix | None = None
    ) -> "Split":
        """Split chi^2 of the data behind a posterior.

        Parameters
        ----------
        posterior : Posterior
            In any form.
        chi2 : float
            Of the data under the model, sky included.
        n_data : int
        matrix : (modes, modes) array, optional
            A^T N^-1 A, if it has been computed.

        Raises
        ------
        InputError
            As :func:`widened`.
        """
        n_known = n_data - expected_chi2(posterior, n_data)
        size = max(1.0, np.sqrt(float(posterior.prior_chi2()) / n_known)) if n_known > 0 else 1.0
        # data that do not fit require a sky that is brighter by orders of magnitude, under which
        # float64 cannot separate noise from sky; they stand out under narrower ones, too
        for factor in (WIDER * size, WIDER, WIDER**0.5):
            with suppress(InputError):
                wide, less = widened(posterior, factor, matrix)
                break
        else:
            wide, less = widened(posterior, 1.0, matrix)
        instrument = beside_any_sky(chi2 - less, wide, n_data)
        return cls(instrument, ChiSquare(less, n_data - instrument.degrees), wide)


def beside_any_sky(chi2: float, wide: Posterior, n_data: int) -> ChiSquare:
    """The part of chi^2 that remains under a wide prior, with its degrees of freedom."""
    return ChiSquare(chi2, float(n_data - with_sky(n_data - expected_chi2(wide, n_data))))


def with_sky(directions: float) -> float:
    """Degrees of freedom that measured directions of the sky use: slightly less than 1 each."""
    return (1.0 - 1.0 / WIDER**2) * directions


def widened(
    posterior: Posterior, factor: float, matrix: ModesMatrix | None = None
) -> tuple[Posterior, float]:
    """Compute the posterior given the same data under a prior with wider standard deviations.

    Parameters
    ----------
    posterior : Posterior
        With NumPy's arrays.
    factor : float
        By which the prior's standard deviations are multiplied; its mean stays the same.
    matrix : (modes, modes) array, optional
        A^T N^-1 A, if it has been computed: a prior without correlations scales it quickly.

    Returns
    -------
    Posterior
        Under the wider prior.
    float
        Decrease of chi^2 of the data under the model.

    Raises
    ------
    InputError
        If Lambda_k cannot be factorised.
    """
    prior, log_det = posterior.prior, log_det_of_lower(posterior.lower)
    off = posterior.white_mean - prior.white_mean
    # outside the span of a basis, the posterior is the prior
    inside = off if posterior.basis is None else posterior.basis.T @ off
    if matrix is not None and prior.independent and posterior.basis is None:
        precision = prior.sandwich(matrix)
    else:
        lower = lower_triangle(posterior.lower)
        precision = times_lower(lower, lower, transpose=True)
        # free memory: the next matrices are as large
        del lower
        precision[np.diag_indices(len(precision))] -= 1.0
    precision *= factor**2
    precision[np.diag_indices(len(precision))] += 1.0
    root = cholesky(precision, overwrite=True)
    if not np.isfinite(np.diagonal(root)).all():
        why = "data are too precise for normal equations to tell noise from sky; use fewer at once"
        raise InputError(why)
    half = solve_lower(root, inside[:, None], transpose=False)
    step = (factor**2 - 1.0) * solve_lower(root, half, transpose=True)[:, 0]
    less = (1.0 - factor**-2) * float(inside @ (inside + step))
    moved = step if posterior.basis is None else posterior.basis @ step
    log_evidence = posterior.log_evidence + 0.5 * (less + log_det - log_det_of_lower(root))
    mean, evidence = (posterior.white_mean + moved) / factor, np.asarray(log_evidence)
    parts = prior.widened(factor), mean, root, posterior.basis, evidence, posterior.refinement
    return Posterior(*parts), less
