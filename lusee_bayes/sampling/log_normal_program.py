"""Coordinates in which the posterior of a log-normal sky is straight.

The program ``log_normal`` uses them to sample a positive sky with fixed or sampled C_ell.

The data measure some combinations of the map to 1e-6 of the prior's width. In the logarithm s of
the sky these are curved surfaces: unconstrained directions move the map by s + s^2 / 2 + ..., and
the second term alone is hundreds of standard deviations of the measured combinations. With the
white unknowns u of :class:`.LogNormalSky`, the information in the data and ::

    E(u) = chi^2(m(u)) / 2 + |u|^2 / 2,    H = J^T M J + 1,    J = dm/du,

the search for the mode u* takes steps -(H + damping)^-1 grad E, halved until they lead downwards.
H omits the second derivative of m times the residuals. Steps that are too long for this, e.g. for
sources fainter than catalogued, are damped. Damping leaves measured directions nearly unchanged, so
chi^2 stays low. With H = V diag(w) V^T at the mode, and directions V_g in groups of increasing w, u
is computed from x by ::

    u = u* + V_0 x_0 + sum_g V_g (k_g x_g + D_g(x_0, ..., x_g-1)),

where D_g keeps the measured part of the map, J^T M (m - m*) along all stiffer directions, at its
value at the mode. D_g depends only on softer coordinates. So the determinant is exactly one (or
that of the scales k, which are not one if C_ell is sampled), however accurate D_g is. A correction
reduces the error by about the rms of the unconstrained part of s, so one is enough if groups differ
by that factor.

If A and the tilt of C_ell are sampled, the mode is the one at their most probable values. With
r = d ln C^(1/2) / d theta, ::

    d ln p(d) / d theta = sum_i r_i (u_i^2 + (H^-1)_ii - 1),
    F = 2 sum_ij r_i (1 - H^-1)_ij^2 r_j

are the slope of the evidence (the slope of the prior, averaged over a Gaussian posterior) and the
Fisher information of data about theta. Steps of F^-1 times the slope lead to its zero. F^-1 is also
the covariance for the coordinates of theta; the covariance of the slopes themselves was 0.8 to 1.5
times as large, which does not affect sampling.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy.linalg import block_diag

from lusee_bayes.core import linalg
from lusee_bayes.core.arrays import Array, on_device, on_host
from lusee_bayes.core.errors import InputError
from lusee_bayes.linear.information import Information
from lusee_bayes.sampling.hmc import Whitening
from lusee_bayes.sampling.log_normal_prior import AMPLITUDE, STRUCTURE, TILT, LogNormalPrior
from lusee_bayes.sky.positive_skies import LogNormalSky, Pair, matching_step
from lusee_bayes.systematics.systematic import Chart

# recurring types of arrays
PairMatrix = Float[np.ndarray, "2 2"]
Unknowns = Float[np.ndarray, " unknowns"]
White = Float[Array, " unknowns"]

# the search ends when a step is shorter than this, in standard deviations of all unknowns together
SETTLED = 1e-3
# ... or shorter than ROUGH after PATIENCE steps: if the curvature is far from H, the end is slow
ROUGH, PATIENCE = 0.1, 40
# a step shorter than this, in standard deviations, is not halved: its gain may be rounding
SHORT = 1.0
MAX_STEPS, HALVINGS = 100, 20
# factor by which damping increases if a step gains less than the fraction POOR of the gain that H
# predicts, and decreases above GOOD, near the mode not far below the value that helped; smaller
# predictions than ROUNDING change nothing
DAMPING, POOR, GOOD, ROUNDING = 4.0, 0.25, 0.75, 1e-5
# the search for A and the tilt ends when a step is shorter than this, in standard deviations
SPECTRUM_SETTLED = 0.02
SPECTRUM_STEPS = 30
# steps of ln A and of the tilt up to which the slope is nearly linear
NEAR = 0.2
# directions with more curvature than this are straightened; the prior's is one
STIFF = 1.5
# a correction reduces errors by this times the rms of the unconstrained s: with 1.25, the energy of
# 2304 unknowns differs from a Gaussian's by 0.8 +- 1.1, with 0.4 by 3.2 +- 2.5
GAIN = 1.25
# smallest ln of the factor between groups: if s is unconstrained, corrections gain nothing
LEAST = 1.0


class StraightSky(Chart):
    """The coordinates of the module's equations, with fixed or sampled C_ell.

    Attributes
    ----------
    sky : LogNormalSky
        With the reference C_ell.
    white : (unknowns,) array
        u* of the mode.
    modes : (modes,) array
        m* of the mode, in K.
    across : (unknowns, directions) array
        V of the stiff directions, the softest first.
    down : (directions, modes) array
        (w - 1)^-1 V^T J^T M: the inverse of J V on its span, in 1/K.
    bounds : tuple of int
        Start of each group of directions, and the end of the last one.
    """

    sky: LogNormalSky
    white: White
    modes: Float[Array, " modes"]
    across: Float[Array, "unknowns directions"]
    down: Float[Array, "directions modes"]
    bounds: tuple[int, ...] = eqx.field(static=True)

    @property
    def names(self) -> tuple[str, ...]:
        return (STRUCTURE, AMPLITUDE, TILT)

    def to_values(self, x):
        sky, scales, along, white = self._begun(x)
        for group in self._groups():
            push = self._correction(sky, white, scales, group)
            push = push.at[: group.stop - group.start].add((scales * along)[group])
            white = white + self.across[:, group.start :] @ push
        return {**x, STRUCTURE: white}, jnp.log(scales).sum()

    def from_values(self, values):
        sky, scales, along, white = self._begun(values)
        shift = self.across.T @ (white - self.white)
        straight = jnp.zeros_like(along)
        for group in self._groups():
            push = self._correction(sky, white, scales, group)
            shift = shift.at[group.start :].add(push)
            part = (along - shift)[group]
            straight = straight.at[group].set(part / scales[group])
            push = push.at[: group.stop - group.start].add(part)
            white = white + self.across[:, group.start :] @ push
        return {**values, STRUCTURE: values[STRUCTURE] + self.across @ (straight - along)}

    def _groups(self) -> list[slice]:
        return [slice(first, end) for first, end in pairwise(self.bounds)]

    def _begun(self, values: dict[str, Array]) -> tuple[LogNormalSky, Array, Array, White]:
        """The sky with the sites' C_ell, k, V^T (x - u*), and u* + V_0 x_0.

        If C_ell differs from the mode's, u* is rescaled so that the logarithm is still the mode's.
        """
        linear = values[STRUCTURE] - self.white
        along = self.across.T @ linear
        if AMPLITUDE not in values:
            scales, kept = jnp.ones_like(along), -along
            sky = self.sky
        else:
            sky = self.sky.with_power_law(jnp.exp(values[AMPLITUDE]), values[TILT])
            ratio = sky.root() / self.sky.root()
            scales = 1.0 / (ratio @ self.across**2)
            kept = self.across.T @ ((1.0 / ratio - 1.0) * self.white) - along
        return sky, scales, along, self.white + linear + self.across @ kept

    def _correction(
        self, sky: LogNormalSky, white: White, scales: Float[Array, " directions"], group: slice
    ) -> Float[Array, " free"]:
        """Steps along a group and all stiffer ones that move the map towards the mode's."""
        off = sky.modes(white) - self.modes
        return -scales[group.start :] * (self.down[group.start :] @ off)


@dataclass(frozen=True)
class LogNormalMode:
    """The most probable sky, and the curvature there.

    Attributes
    ----------
    sky : LogNormalSky
    information : Information
        Information in the data; its reference is the mode's sky.
    white : (unknowns,) array
        u at the mode.
    jacobian : (modes, unknowns) array
        J at the mode, in K.
    lower : (unknowns, unknowns) array
        L of H = L L^T.
    power_law : (2,) array, optional
        ln A and the tilt of C_ell, if they are unknowns.
    covariance : (2, 2) array, optional
        Covariance of ln A and the tilt.
    """

    sky: LogNormalSky
    information: Information
    white: Unknowns
    jacobian: Float[np.ndarray, "modes unknowns"]
    lower: Float[np.ndarray, "unknowns unknowns"]
    power_law: Pair | None = None
    covariance: PairMatrix | None = None


def find_mode(
    sky: LogNormalSky, information: Information, start: Unknowns | None = None
) -> LogNormalMode:
    """Find the mode of p(u | d).

    Parameters
    ----------
    sky : LogNormalSky
        The prior.
    information : Information
        Information in the data.
    start : (unknowns,) array, optional
        u of the start; by default zero, i.e. the template.

    Returns
    -------
    LogNormalMode
        In NumPy arrays.

    Raises
    ------
    InputError
        If the search does not converge in 100 steps.
    """
    sky, information = on_host((sky, information))
    white = np.zeros(sky.size) if start is None else np.array(start, dtype=np.float64)
    local, moved, damping, least = information.recentred(sky.modes(white)), np.inf, 0.0, 0.0
    for steps in range(MAX_STEPS + 1):
        jacobian = sky.jacobian(white)
        curvature = linalg.symmetric_product(jacobian.T @ local.matrix, jacobian)
        curvature[np.diag_indices(len(curvature))] += 1.0
        lower = linalg.checked_cholesky("the curvature of the posterior", curvature)
        slope = white - jacobian.T @ local.vector
        half = linalg.solve_lower(lower, slope[:, None], transpose=False)
        moved = float(np.linalg.norm(half))
        if moved < (SETTLED if steps < PATIENCE else ROUGH):
            return LogNormalMode(sky, local, white, jacobian, lower)
        if damping:
            damped = curvature + damping * np.eye(sky.size)
            lower = linalg.checked_cholesky("the damped curvature", damped)
            half = linalg.solve_lower(lower, slope[:, None], transpose=False)
        step, energy = linalg.solve_lower(lower, half, transpose=True)[:, 0], _energy(local, white)
        white, local = _descended(sky, local, white, step, moved < SHORT)
        promised = float(2.0 * step @ slope - step @ curvature @ step)
        gained = (energy - _energy(local, white)) / max(promised, ROUNDING)
        if promised > ROUNDING and gained < POOR:
            damping = max(DAMPING * damping, 1.0)
            least = damping if moved < SHORT else least
        elif promised > ROUNDING and gained > GOOD:
            damping, least = max(damping / DAMPING if damping > 1.0 else 0.0, least), 0.7 * least
    raise InputError(
        f"found no mode of the log-normal sky in {MAX_STEPS} steps (last step: {moved:.2g} "
        "standard deviations); the data are far from the template: check their scale, or raise "
        "log_normal.scale_std"
    )


def _energy(information: Information, white: Unknowns) -> float:
    """2 E at the reference sky of the information."""
    return float(information.misfit) + float(white @ white)


def _descended(
    sky: LogNormalSky, local: Information, white: Unknowns, step: Unknowns, short: bool
) -> tuple[Unknowns, Information]:
    """The unknowns after a step, and the information about their sky."""
    energy = _energy(local, white)
    for _ in range(HALVINGS):
        trial = white - step
        # far from the mode the sky may overflow: such a step is halved
        with np.errstate(over="ignore", invalid="ignore"):
            moved = local.recentred(sky.modes(trial))
            if short or _energy(moved, trial) < energy:
                return trial, moved
        step = 0.5 * step
    return white, local


def learn_spectrum(prior: LogNormalPrior, information: Information) -> LogNormalMode:
    """Find the mode at C_ell of maximum evidence, p(d | A, tilt) p(A, tilt).

    Parameters
    ----------
    prior : LogNormalPrior
        With sampled A and tilt.
    information : Information
        Information in the data.

    Raises
    ------
    InputError
        If the search does not converge in 30 steps, or one of them finds no mode.
    """
    sky, start = prior.sky, None
    centre, narrow = prior.expected, prior.std**-2.0
    theta = centre
    for _ in range(SPECTRUM_STEPS + 1):
        sky = sky.with_power_law(np.exp(theta[0]), theta[1])
        mode = find_mode(sky, information, start)
        slope, fisher, known = _evidence_about(mode)
        slope, fisher = slope - narrow * (theta - centre), fisher + np.diag(narrow)
        step = np.linalg.solve(fisher, slope)
        if np.sqrt(slope @ step) < SPECTRUM_SETTLED:
            return replace(mode, power_law=theta, covariance=np.linalg.inv(fisher))
        if np.abs(step).max() > NEAR:
            power = mode.white[: sky.n_modes] ** 2
            step = matching_step(power, known, sky.power_law_slopes(), theta - centre, narrow)
        # after a short step, keep the logarithm, which the data measure
        theta = theta + step
        ratio = sky.root() / sky.with_power_law(np.exp(theta[0]), theta[1]).root()
        start = mode.white * ratio if np.abs(step).max() < NEAR else None
    raise InputError(
        f"found no maximum of the evidence in {SPECTRUM_STEPS} steps: A = {np.exp(theta[0]):.3g}, "
        f"tilt = {theta[1]:.3g}; give log_normal.amplitude and log_normal.tilt"
    )


def _evidence_about(mode: LogNormalMode) -> tuple[Pair, PairMatrix, Unknowns]:
    """Slope of the evidence, Fisher information, and 1 - (H^-1)_ii for every mode of the map."""
    sky, slopes = mode.sky, mode.sky.power_law_slopes()
    left = linalg.inverse_from_cholesky(mode.lower)[: sky.n_modes, : sky.n_modes]
    slope = slopes @ (mode.white[: sky.n_modes] ** 2 + np.diagonal(left) - 1.0)
    known = np.eye(sky.n_modes) - left
    return slope, 2.0 * slopes @ (known**2 @ slopes.T), np.diagonal(known)


def coordinates_of(prior: LogNormalPrior, information: Information) -> Whitening:
    """Make the coordinates of the posterior under a prior.

    Parameters
    ----------
    prior : LogNormalPrior
    information : Information
        Information in the data.

    Raises
    ------
    InputError
        As :func:`find_mode` and :func:`learn_spectrum`.
    """
    prior = on_host(prior)
    learned = prior.std is not None
    mode = learn_spectrum(prior, information) if learned else find_mode(prior.sky, information)
    return straight_coordinates(mode)


def straight_coordinates(mode: LogNormalMode) -> Whitening:
    """Make the coordinates about a mode.

    Parameters
    ----------
    mode : LogNormalMode

    Returns
    -------
    Whitening
        For the site ``structure``, after ``amplitude`` and ``tilt`` if they are unknowns; in JAX
        arrays.
    """
    strength, vectors = np.linalg.eigh(mode.lower @ mode.lower.T)
    stiff = slice(int(np.searchsorted(strength, STIFF)), None)
    across = np.ascontiguousarray(vectors[:, stiff])
    pulled = (across.T @ mode.jacobian.T) @ mode.information.matrix
    down = pulled / (strength[stiff] - 1.0)[:, None]
    root = vectors / np.sqrt(strength)[None]
    left_open = ((mode.sky.root()[:, None] * root)[: mode.sky.n_modes] ** 2).sum() / (4.0 * np.pi)
    if mode.covariance is not None:  # a sampled C_ell moves the logarithm, too
        slopes = mode.sky.power_law_slopes()[:, 1:]
        left_open += np.einsum("im,ij,jm->m", slopes, mode.covariance, slopes).max()
    bounds = _bounds(strength[stiff], GAIN**2 * left_open)
    chart = StraightSky(mode.sky, mode.white, mode.information.reference, across, down, bounds)
    log_det, mean = -np.log(np.diagonal(mode.lower)).sum(), mode.white
    sites: tuple[tuple[str, tuple[int, ...]], ...] = ((STRUCTURE, (mode.sky.size,)),)
    if mode.power_law is not None:
        law_root = np.linalg.cholesky(mode.covariance)
        log_det = log_det + np.log(np.diagonal(law_root)).sum()
        mean, root = np.concatenate([mode.power_law, mean]), block_diag(law_root, root)
        sites = ((AMPLITUDE, ()), (TILT, ()), *sites)
    return on_device(Whitening(mean, root, np.asarray(log_det), sites, chart))


def _bounds(strength: Float[np.ndarray, " directions"], gain: float) -> tuple[int, ...]:
    """Bounds of groups in which curvatures differ by less than a factor max(1 / gain, e^LEAST)."""
    group = np.floor(np.log(strength / STIFF) / max(np.log(1.0 / gain), LEAST)).astype(int)
    first = np.flatnonzero(np.diff(group, prepend=-1))
    return (*first.tolist(), len(strength))
