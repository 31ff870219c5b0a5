"""Preconditioned conjugate gradients for several right-hand sides at once, with its convergence.

For Lambda x = b with Lambda symmetric and positive definite. The distance to the solution is told
in standard deviations of N(0, Lambda^-1), all components together: |L^T (x - Lambda^-1 b)| with
Lambda = L L^T, which sqrt(r . P r) estimates, r being the residual and P the preconditioner.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from lusee_bayes.checks import InputError

Operator = Callable[[Array], Array]


@dataclass(frozen=True)
class Solution:
    """x (systems, unknowns), iterations taken, and the distance left of each system."""

    x: Float[Array, "systems unknowns"]
    iterations: int
    distance: Float[np.ndarray, " systems"]


def conjugate_gradients(
    apply: Operator,
    right: Float[Array, "systems unknowns"],
    precondition: Operator,
    *,
    tolerance: float = 1e-7,
    iterations: int = 500,
    report: Callable[[int, str], None] | None = None,
) -> Solution:
    """Solve until every system is within ``tolerance`` standard deviations.

    apply, precondition : Lambda and P on rows of (systems, unknowns); report : told the iteration
    and a remark after each. InputError if that takes more than ``iterations``.
    """
    x, residual = jnp.zeros_like(right), right
    z = precondition(residual)
    direction, power = z, (residual * z).sum(1)
    for count in range(iterations + 1):
        squared = np.asarray(power)
        if not (squared >= 0).all():
            raise InputError(
                f"conjugate gradients broke down after {count} iterations: the matrix or its "
                "preconditioner is not positive definite"
            )
        distance = np.sqrt(squared)
        if report is not None:
            report(count, f"{distance.max():.1e} sigma left")
        if (distance <= tolerance).all():
            return Solution(x, count, distance)
        if count == iterations:
            break
        pushed = apply(direction)
        curvature = (direction * pushed).sum(1)
        # a system that is solved already has no direction left
        live = power > 0
        step = jnp.where(live, power / jnp.where(live, curvature, 1.0), 0.0)
        x = x + step[:, None] * direction
        residual = residual - step[:, None] * pushed
        z = precondition(residual)
        previous, power = power, (residual * z).sum(1)
        ratio = jnp.where(live, power / jnp.where(live, previous, 1.0), 0.0)
        direction = z + ratio[:, None] * direction
    raise InputError(
        f"conjugate gradients did not converge: after {iterations} iterations the solution is "
        f"still {distance.max():.2g} standard deviations away (accepted: {tolerance:g}); raise "
        "spectral.iterations, or take fewer components for spectral.solver=direct"
    )
