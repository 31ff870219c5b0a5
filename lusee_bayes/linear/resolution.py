"""Rows of the resolution matrix: the point-spread functions of a map.

On average over noise the posterior mean is R m, R = C A^T N^-1 A = 1 - C S^-1. A pixel in direction
p is y_p^T R m: an integral of the sky with the kernel R(p, q) = y_p^T R y_q over directions q.
"""

from __future__ import annotations

from jaxtyping import Float

from lusee_bayes.core.arrays import Array, compiled, namespace
from lusee_bayes.core.errors import InputError
from lusee_bayes.core.linalg import solve_lower
from lusee_bayes.linear.posterior import Posterior


def resolution_rows(
    posterior: Posterior, directions: Float[Array, "n modes"]
) -> Float[Array, "n modes"]:
    """Compute y^T R for linear combinations y of the modes.

    Parameters
    ----------
    posterior : Posterior
        Over harmonic coefficients.
    directions : (n, modes) array
        One y a row, for example of ``harmonics.pixel_matrix``.

    Returns
    -------
    (n, modes) array
        Rows of y^T R. Their values in a direction q, ``rows @ y_q``, are per steradian. Columns of
        modes without prior variance are zero, as those modes are in the map.

    Raises
    ------
    InputError
        If the prior is not over harmonic coefficients.
    """
    if not posterior.prior.invertible:
        raise InputError("resolution needs a prior over harmonic coefficients")
    return _rows(posterior, namespace(posterior).asarray(directions))


@compiled
def _rows(posterior: Posterior, directions: Float[Array, "n modes"]) -> Float[Array, "n modes"]:
    """y G (1 - C_w) G^-1, C_w the covariance of u."""
    white = posterior.prior.colour_columns(directions)
    inside = white if posterior.basis is None else white @ posterior.basis
    half = solve_lower(posterior.lower, inside.T, transpose=False)
    known = inside - solve_lower(posterior.lower, half, transpose=True).T
    if posterior.basis is not None:
        known = known @ posterior.basis.T
    return posterior.prior.whiten_columns(known)
