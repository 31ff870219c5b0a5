"""C_ell of a log-normal sky's logarithm, A^2 ((ell + 1) / 10)^tilt, by maximum evidence.

At the mode of given (A, tilt), with H of :mod:`.gauss_newton` and r = d ln C^(1/2) / d theta, ::

    d ln p(d) / d theta = sum_i r_i (u_i^2 + (H^-1)_ii - 1),
    F = 2 sum_ij r_i (1 - H^-1)_ij^2 r_j

are the slope of the evidence (the prior's own slope, averaged over a Gaussian posterior) and the
Fisher information of data about theta. Steps F^-1 times the slope find where it is zero; how it
changes there says how well the data know theta.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from lusee_bayes.core.errors import InputError
from lusee_bayes.core.linalg import inverse_from_cholesky
from lusee_bayes.linear.information import Information
from lusee_bayes.sampling.log_normal.gauss_newton import LogNormalMode, find_mode
from lusee_bayes.sampling.log_normal.prior import LogNormalPrior

# found when a step is shorter than this, in standard deviations
SETTLED = 0.02
MAX_STEPS = 30
# steps of ln A and of the tilt up to which the slope is nearly straight, and longest step
NEAR, REACH = 0.2, 3.0


@dataclass(frozen=True, repr=False)
class LearnedSpectrum:
    """C_ell of maximum evidence, and the mode there.

    Attributes
    ----------
    prior : LogNormalPrior
        With the A and tilt that were found; known from here on.
    covariance : (2, 2) array
        Of ln A and the tilt.
    mode : LogNormalMode
    steps : int
    """

    prior: LogNormalPrior
    covariance: Float[np.ndarray, "2 2"]
    mode: LogNormalMode
    steps: int


def learn_spectrum(prior: LogNormalPrior, information: Information) -> LearnedSpectrum:
    """Maximise p(d | A, tilt) p(A, tilt).

    Parameters
    ----------
    prior : LogNormalPrior
        With A and tilt not known.
    information : Information
        Of the data.

    Raises
    ------
    InputError
        If A and the tilt are known, if no maximum is found in 30 steps, or for one of them no mode.
    """
    if not prior.is_learned:
        raise InputError("A and the tilt are known; give the standard deviations of their priors")
    sky, start, last = prior.sky, None, None
    centre = np.array([np.log(prior.amplitude), prior.tilt])
    narrow = np.array([prior.log_amplitude_std, prior.tilt_std], dtype=float) ** -2.0
    theta, bend = centre, np.zeros((2, 2))
    for steps in range(MAX_STEPS + 1):
        sky = sky.with_power_law(np.exp(theta[0]), theta[1])
        mode = find_mode(sky, information, start)
        slope, fisher = _slope_and_fisher(mode)
        slope, fisher = slope - narrow * (theta - centre), fisher + np.diag(narrow)
        if np.sqrt(slope @ np.linalg.solve(fisher, slope)) < SETTLED:
            found = LogNormalPrior.of(sky, float(np.exp(theta[0])), float(theta[1]))
            covariance = _covariance(found, mode, np.linalg.inv(fisher), narrow)
            return LearnedSpectrum(found, covariance, mode, steps)
        if last is not None:  # what the Fisher information of the last step did not foresee
            moved = theta - last[0]
            bend = np.outer(last[1] - slope - last[2] @ moved, moved) / (moved @ moved)
        step = np.linalg.solve(fisher + bend, slope)
        if np.abs(step).max() > NEAR or step @ slope <= 0:
            step, bend = _matched(mode, centre - theta, narrow), np.zeros((2, 2))
        last = theta, slope, fisher
        # near by, the logarithm stays as it is: the data know it
        theta = theta + step
        ratio = sky.root() / sky.with_power_law(np.exp(theta[0]), theta[1]).root()
        start = mode.white * ratio if np.abs(step).max() < NEAR else None
    raise InputError(
        f"no maximum of the evidence was found in {MAX_STEPS} steps: A = {np.exp(theta[0]):.3g}, "
        f"tilt = {theta[1]:.3g}; give narrower priors, or say what they are"
    )


def _covariance(
    prior: LogNormalPrior,
    mode: LogNormalMode,
    expected: Float[np.ndarray, "2 2"],
    narrow: Float[np.ndarray, "2"],
) -> Float[np.ndarray, "2 2"]:
    """That of ln A and the tilt, from slopes one expected standard deviation away."""
    moves, rows = np.linalg.cholesky(expected).T, []
    for move in moves:
        slopes = []
        for sign in (1.0, -1.0):
            amplitude = float(prior.amplitude) * np.exp(sign * move[0])
            sky = prior.sky.with_power_law(amplitude, float(prior.tilt) + sign * move[1])
            start = mode.white * prior.sky.root() / sky.root()
            slopes.append(_slope_and_fisher(find_mode(sky, mode.information, start))[0])
        rows.append(0.5 * (slopes[1] - slopes[0]))
    curvature = np.linalg.solve(moves, np.array(rows))
    curvature = 0.5 * (curvature + curvature.T) + np.diag(narrow)
    if np.linalg.eigvalsh(curvature).min() <= 0:
        raise InputError(
            f"the evidence has no maximum near A = {float(prior.amplitude):.3g}, tilt = "
            f"{float(prior.tilt):.3g}: the data do not tell them; give narrower priors"
        )
    return np.linalg.inv(curvature)


def _slope_and_fisher(
    mode: LogNormalMode,
) -> tuple[Float[np.ndarray, "2"], Float[np.ndarray, "2 2"]]:
    sky, slopes = mode.sky, mode.sky.power_law_slopes()
    left = inverse_from_cholesky(mode.lower)[: sky.n_modes, : sky.n_modes]
    slope = slopes @ (mode.white[: sky.n_modes] ** 2 + np.diagonal(left) - 1.0)
    known = np.eye(sky.n_modes) - left
    return slope, 2.0 * slopes @ (known**2 @ slopes.T)


def _matched(
    mode: LogNormalMode, centre: Float[np.ndarray, "2"], narrow: Float[np.ndarray, "2"]
) -> Float[np.ndarray, "2"]:
    """The step after which the modes have as much power as they should, each for itself.

    u_i^2 is 1 - (H^-1)_ii on average where theta is right. This goes far where a slope does not.
    """
    sky = mode.sky
    left = np.diagonal(inverse_from_cholesky(mode.lower))[: sky.n_modes]
    slopes, known, power = sky.power_law_slopes(), 1.0 - left, mode.white[: sky.n_modes] ** 2
    step = np.zeros(2)
    for _ in range(MAX_STEPS):
        expected = known * np.exp(2.0 * (step @ slopes))
        slope = slopes @ (known * (power / expected - 1.0)) + narrow * (centre - step)
        fisher = 2.0 * (slopes * np.maximum(known, power * known / expected)) @ slopes.T
        step = step + np.linalg.solve(fisher + np.diag(narrow), slope)
    return np.clip(step, -REACH, REACH)
