"""chi^2 of data in two parts: what no sky explains, and what the prior does not expect."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lusee_bayes.core.arrays import ModesMatrix, Square
from lusee_bayes.core.errors import InputError
from lusee_bayes.core.linalg import cholesky, solve_lower, times_lower
from lusee_bayes.judge.chi2 import ChiSquare
from lusee_bayes.judge.measures import expected_chi2
from lusee_bayes.linear.posterior import Posterior

# k over the sky's own size, in units of the prior
WIDER = 10.0


@dataclass(frozen=True)
class Split:
    """chi^2 of data in its two parts.

    Attributes
    ----------
    instrument : ChiSquare
        What no sky explains: tests A and N.
    prior : ChiSquare
        The rest: tests the prior, if A and N are right.
    wide : Posterior
        Given the same data under the wide prior.
    """

    instrument: ChiSquare
    prior: ChiSquare
    wide: Posterior

    @classmethod
    def of(
        cls,
        posterior: Posterior,
        chi2: float,
        n_data: int,
        matrix: ModesMatrix | None = None,
        expected: float | None = None,
    ) -> Split:
        """Split chi^2 of the data behind a posterior.

        Parameters
        ----------
        posterior : Posterior
            In any form.
        chi2 : float
            Of the data under the model, sky included.
        n_data : int
        matrix : (modes, modes) array, optional
            A^T N^-1 A, where it is known.
        expected : float, optional
            :func:`.expected_chi2`, where it is known.

        Raises
        ------
        InputError
            As :func:`widened`.
        """
        n_known = n_data - (expected_chi2(posterior, n_data) if expected is None else expected)
        size = max(1.0, np.sqrt(float(posterior.prior_chi2()) / n_known)) if n_known > 0 else 1.0
        try:
            wide, less = widened(posterior, WIDER * size, matrix)
        except InputError:
            # data that do not fit ask for a sky that is stronger by orders of magnitude, under
            # which numbers of 64 bits do not tell noise from sky; they stand out under this, too
            wide, less = widened(posterior, WIDER, matrix)
        degrees = n_data - with_sky(n_data - expected_chi2(wide, n_data))
        instrument = ChiSquare(chi2 - less, float(degrees))
        return cls(instrument, ChiSquare(less, float(n_data - degrees)), wide)


def with_sky(directions: float) -> float:
    """Degrees of freedom that measured directions of the sky take: a little is left of each."""
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
        By which the prior's standard deviations are multiplied, about the same mean.
    matrix : (modes, modes) array, optional
        A^T N^-1 A, where it is known: a prior without correlations scales it in no time.

    Returns
    -------
    Posterior
        Under the wider prior.
    float
        By how much chi^2 of the data under the model is smaller than before.

    Raises
    ------
    InputError
        If Lambda_k cannot be factorised.
    """
    prior, log_det = posterior.prior, log_det_of(posterior.lower)
    off = posterior.white_mean - prior.white_mean
    # with a basis, outside of its span the posterior is the prior
    inside = off if posterior.basis is None else posterior.basis.T @ off
    if matrix is not None and prior.independent and posterior.basis is None:
        precision = prior.sandwich(matrix)
    else:
        lower = np.tril(posterior.lower)
        precision = times_lower(lower, lower, transpose=True)
        # as large as what follows
        del lower
        precision[np.diag_indices(len(precision))] -= 1.0
    precision *= factor**2
    precision[np.diag_indices(len(precision))] += 1.0
    root = cholesky(precision, overwrite=True)
    if not np.isfinite(np.diagonal(root)).all():
        raise InputError(
            "the data are too precise for the normal equations to separate noise from sky; use "
            "fewer data at once"
        )
    half = solve_lower(root, inside[:, None], transpose=False)
    step = (factor**2 - 1.0) * solve_lower(root, half, transpose=True)[:, 0]
    less = (1.0 - factor**-2) * float(inside @ (inside + step))
    moved = step if posterior.basis is None else posterior.basis @ step
    log_evidence = posterior.log_evidence + 0.5 * (less + log_det - log_det_of(root))
    mean, evidence = (posterior.white_mean + moved) / factor, np.asarray(log_evidence)
    parts = prior.widened(factor), mean, root, posterior.basis, evidence, posterior.refinement
    return Posterior(*parts), less


def log_det_of(root: Square) -> float:
    """ln|M| of a matrix with this Cholesky factor."""
    return 2.0 * float(np.log(np.diagonal(root)).sum())
