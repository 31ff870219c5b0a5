"""The information of data about some of the unknowns, the others integrated out."""

from __future__ import annotations

from jaxtyping import Float

from lusee_bayes.core.arrays import Array, namespace
from lusee_bayes.core.checks import require_shape
from lusee_bayes.core.linalg import cholesky, scaled, solve_lower
from lusee_bayes.linear.information import Information


def marginalised(
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
