"""The mode of a log-normal sky's posterior, by Gauss and Newton.

With the white unknowns u of :class:`.LogNormalSky` and the information of the data ::

    E(u) = chi^2(m(u)) / 2 + |u|^2 / 2,    H = J^T M J + 1,    J = dm/du,

a step is -(H + damping)^-1 grad E, halved until it leads downwards. H leaves out the second
derivative of m, which the residuals multiply: 0.1 in ln evidence at the fiducial size. Where steps
are too long for that, as for sources of which there is less than catalogued, they are damped: what
the data know is not, so that they stay where chi^2 is low.
"""

from __future__ import annotations

import equinox as eqx
import numpy as np
from jaxtyping import Float

from lusee_bayes.core.arrays import on_host
from lusee_bayes.core.checks import require_shape
from lusee_bayes.core.errors import InputError
from lusee_bayes.core.linalg import checked_cholesky, solve_lower, symmetric_product
from lusee_bayes.core.representation import Described, number
from lusee_bayes.linear.information import Information
from lusee_bayes.sky.log_normal import LogNormalSky

# the mode is found when a step is shorter than this, in standard deviations, all unknowns together
SETTLED = 1e-3
# ... or than that after so many steps: where the curvature is far from H, the last ones are slow
ROUGH, PATIENCE = 0.1, 40
# a step of less than one standard deviation is taken as it is: what it gains may be rounding
SHORT = 1.0
MAX_STEPS, HALVINGS = 100, 20
# factor by which steps are damped more, after one that gains less than this part of what H
# promises, or less, after one that gains more; near the mode not much less than what helped. What
# a step gains is told from rounding if so much is promised
DAMPING, POOR, GOOD, ROUNDING = 4.0, 0.25, 0.75, 1e-5


class LogNormalMode(Described, eqx.Module):
    """The likeliest sky, and the curvature there.

    Attributes
    ----------
    sky : LogNormalSky
    information : Information
        Of the data; its reference is the sky of the mode.
    white : (unknowns,) array
        u of the mode.
    jacobian : (modes, unknowns) array
        J there, in K.
    lower : (unknowns, unknowns) array
        L of H = L L^T.
    log_evidence : () array
        ln p(d) of the Gaussian with this mode and curvature, for data in K.
    moved : () array
        Length of the last step, in standard deviations.
    steps : int
        How many were taken.
    """

    sky: LogNormalSky
    information: Information
    white: Float[np.ndarray, " unknowns"]
    jacobian: Float[np.ndarray, "modes unknowns"]
    lower: Float[np.ndarray, "unknowns unknowns"]
    log_evidence: Float[np.ndarray, ""]
    moved: Float[np.ndarray, ""]
    steps: int = eqx.field(static=True)

    def description(self) -> tuple[str, ...]:
        return (
            f"{self.sky.size} white unknowns of a log-normal sky, lmax = {self.sky.lmax}",
            f"ln evidence {number(self.log_evidence)} (Laplace), found in {self.steps} steps, the "
            f"last of {number(self.moved, '.2g')} standard deviations",
        )

    @property
    def modes(self) -> Float[np.ndarray, " modes"]:
        """The sky of the mode: real packed coefficients, Galactic, in K."""
        return np.asarray(self.information.reference)


def find_mode(
    sky: LogNormalSky,
    information: Information,
    start: Float[np.ndarray, " unknowns"] | None = None,
) -> LogNormalMode:
    """Climb to the mode of p(u | d).

    Parameters
    ----------
    sky : LogNormalSky
        The prior.
    information : Information
        Of the data.
    start : (unknowns,) array, optional
        u to begin from; by default zero, the template itself.

    Returns
    -------
    LogNormalMode
        In NumPy's arrays.

    Raises
    ------
    InputError
        If the information is of another lmax, or no mode is found in 100 steps.
    """
    sky, information = on_host((sky, information))
    require_shape("the information", information.matrix, (sky.n_modes, sky.n_modes))
    white = np.zeros(sky.size) if start is None else np.array(start, dtype=np.float64)
    require_shape("the start", white, (sky.size,))
    here, moved, damping, least = information.recentred(sky.modes(white)), np.inf, 0.0, 0.0
    for steps in range(MAX_STEPS + 1):
        jacobian = sky.jacobian(white)
        curvature = _curvature(here, jacobian)
        lower = checked_cholesky("the curvature of the posterior", curvature)
        slope = white - jacobian.T @ here.vector
        half = solve_lower(lower, slope[:, None], transpose=False)
        moved = float(np.linalg.norm(half))
        if moved < (SETTLED if steps < PATIENCE else ROUGH):
            log_evidence = -0.5 * (
                float(here.misfit)
                + white @ white
                + float(here.log_det)
                + 2.0 * np.log(np.diagonal(lower)).sum()
                + float(here.n_data) * np.log(2.0 * np.pi)
            )
            evidence, moved = np.asarray(log_evidence), np.asarray(moved)
            return LogNormalMode(sky, here, white, jacobian, lower, evidence, moved, steps)
        if damping:
            damped = curvature + damping * np.eye(sky.size)
            lower = checked_cholesky("the damped curvature", damped)
            half = solve_lower(lower, slope[:, None], transpose=False)
        step, energy = solve_lower(lower, half, transpose=True)[:, 0], _energy(here, white)
        white, here = _descended(sky, here, white, step, moved < SHORT)
        promised = float(2.0 * step @ slope - step @ curvature @ step)
        gained = (energy - _energy(here, white)) / max(promised, ROUNDING)
        if promised > ROUNDING and gained < POOR:
            damping = max(DAMPING * damping, 1.0)
            least = damping if moved < SHORT else least
        elif promised > ROUNDING and gained > GOOD:
            damping, least = max(damping / DAMPING if damping > 1.0 else 0.0, least), 0.7 * least
    raise InputError(
        f"no mode of the log-normal sky was found in {MAX_STEPS} steps (the last moved by "
        f"{moved:.2g} standard deviations); the data are far from anything that the template "
        "allows: check the template's scale, or raise the prior's amplitude"
    )


def _curvature(
    information: Information, jacobian: Float[np.ndarray, "modes unknowns"]
) -> Float[np.ndarray, "unknowns unknowns"]:
    curvature = symmetric_product(jacobian.T @ information.matrix, jacobian)
    curvature[np.diag_indices(len(curvature))] += 1.0
    return curvature


def _energy(information: Information, white: Float[np.ndarray, " unknowns"]) -> float:
    """2 E, at the sky that the information is about."""
    return float(information.misfit) + float(white @ white)


def _descended(
    sky: LogNormalSky,
    here: Information,
    white: Float[np.ndarray, " unknowns"],
    step: Float[np.ndarray, " unknowns"],
    short: bool,
) -> tuple[Float[np.ndarray, " unknowns"], Information]:
    """The unknowns behind a step, and the information about their sky."""
    energy = _energy(here, white)
    for _ in range(HALVINGS):
        trial = white - step
        # far from the mode the sky may leave the range of numbers, which no energy is below
        with np.errstate(over="ignore", invalid="ignore"):
            there = here.recentred(sky.modes(trial))
            if short or _energy(there, trial) < energy:
                return trial, there
        step = 0.5 * step
    return white, here
