"""What a map's pixels are made of: rows of the resolution matrix, the point-spread functions.

On average over noise the posterior mean is R m, R = C A^T N^-1 A = 1 - C S^-1. A pixel in direction
p is y_p^T R m: an integral of the sky with the kernel R(p, q) = y_p^T R y_q over directions q.
"""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from lusee_bayes.checks import AnyArray, InputError
from lusee_bayes.covariance.base import solve_lower
from lusee_bayes.posterior import Posterior


def resolution_rows(
    posterior: Posterior, directions: Float[AnyArray, "n modes"]
) -> Float[Array, "n modes"]:
    """y^T R for each row y of ``directions``, for example of ``harmonics.pixel_matrix``.

    Their values in a direction q, ``rows @ y_q``, are per steradian. Modes without any prior
    variance stay zero in the map: so do their columns. InputError for a prior over pixels.
    """
    if posterior.prior.diagonal_root() is None:
        raise InputError("resolution needs a prior over harmonic coefficients")
    return _rows(posterior, jnp.asarray(directions))


@eqx.filter_jit
def _rows(posterior: Posterior, directions: Float[Array, "n modes"]) -> Float[Array, "n modes"]:
    """y D (1 - C_w) D^-1 in white coordinates, D the prior's standard deviations."""
    scale = posterior.prior.diagonal_root()
    white = directions * scale[None]
    inside = white if posterior.basis is None else white @ posterior.basis
    half = solve_lower(posterior.lower, inside.T, transpose=False)
    known = inside - solve_lower(posterior.lower, half, transpose=True).T
    if posterior.basis is not None:
        known = known @ posterior.basis.T
    divisor = jnp.where(scale > 0, scale, 1.0)
    return jnp.where((scale > 0)[None], known / divisor[None], 0.0)
