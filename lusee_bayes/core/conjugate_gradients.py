"""Preconditioned conjugate gradients for several right-hand sides at once.

For Lambda x = b with Lambda symmetric and positive definite. The distance to the solution is
measured in standard deviations of N(0, Lambda^-1), all components together:
``|L^T (x - Lambda^-1 b)|`` with Lambda = L L^T. It is estimated by sqrt(r . P r), with the
residual r and the preconditioner P.

No library offers this stopping rule together with a progress report. jax.scipy.sparse.linalg.cg and
lineax.CG stop by it only if P is split into square roots, report nothing while they run, and the
former does not tell whether it converged. They are faster: 98 iterations for 768 unknowns and 21
right-hand sides take 0.8 and 1.0 s of processor time, and 2.1 s here; 15 iterations for 6912
unknowns in six channels take 2.5 s with jax.scipy, and 4.0 s here.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from lusee_bayes.core.arrays import Array
from lusee_bayes.core.errors import InputError

Operator = Callable[[Array], Array]


@dataclass(frozen=True)
class Solution:
    """The solutions of all systems.

    Attributes
    ----------
    x : (systems, unknowns) array
        One solution a row.
    iterations : int
        Iterations taken.
    distance : (systems,) array
        Estimated distance to the exact solution, in standard deviations.
    """

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
    """Solve until every system is within ``tolerance`` standard deviations of its solution.

    Parameters
    ----------
    apply : callable
        Multiplies every row of a (systems, unknowns) array with Lambda.
    right : (systems, unknowns) array
        Right-hand sides b, one a row.
    precondition : callable
        Multiplies every row with P, an approximation of Lambda^-1.
    tolerance : float
        Accepted distance, in standard deviations.
    iterations : int
        Most iterations.
    report : callable, optional
        Called with the number of every iteration and a remark.

    Returns
    -------
    Solution
        Of all systems.

    Raises
    ------
    InputError
        If that takes more than ``iterations``, or Lambda or P is not positive definite.
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
