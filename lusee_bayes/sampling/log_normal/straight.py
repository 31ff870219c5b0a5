"""Coordinates in which the posterior of a log-normal sky is straight.

The data know some combinations of the map to 1e-6 of what the prior allows. In the logarithm s of
the sky these are curved surfaces: what the data leave open moves the map by s + s^2 / 2 + ..., and
the second term alone is hundreds of standard deviations of what they know. With H = V diag(w) V^T
the curvature at the mode u*, and directions V_g in groups of rising w, x is made u by ::

    u = u* + V_0 x_0 + sum_g V_g (k_g x_g + D_g(x_0, ..., x_g-1)),

where D_g keeps what the data know of the map, J^T M (m - m*) along all stiffer directions, as it is
at the mode. What D_g depends on are softer coordinates only, so that the determinant is one (that
of the scales k, which are not one where C_ell is sampled), however well D_g does its work. A
correction gains a factor of about the rms of what the data leave open of s, so that one is enough
where groups differ by as much.
"""

from __future__ import annotations

from itertools import pairwise

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy.linalg import block_diag

from lusee_bayes.core.arrays import Array, on_device
from lusee_bayes.sampling.log_normal.gauss_newton import LogNormalMode
from lusee_bayes.sampling.log_normal.prior import AMPLITUDE, STRUCTURE, TILT
from lusee_bayes.sampling.whitening import Whitening
from lusee_bayes.sky.log_normal import LogNormalSky
from lusee_bayes.systematics.chart import Chart

# curvature from which on directions are made straight; the prior's is one
STIFF = 1.5
# a correction gains the rms of s that is left open times this: with 1.25, the energy of 2304
# unknowns differs from that of a Gaussian by 0.8 +- 1.1, with 0.4 by 3.2 +- 2.5
GAIN = 1.25
# least ln of the factor between groups: where the data leave s open, corrections gain nothing
LEAST = 1.0


class StraightSky(Chart):
    """The coordinates of the module's equations; without C_ell as unknowns, or with them.

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
        Where each group of directions begins, and where the last ends.
    """

    sky: LogNormalSky
    white: Float[Array, " unknowns"]
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
        found = jnp.zeros_like(along)
        for group in self._groups():
            push = self._correction(sky, white, scales, group)
            shift = shift.at[group.start :].add(push)
            own = (along - shift)[group]
            found = found.at[group].set(own / scales[group])
            push = push.at[: group.stop - group.start].add(own)
            white = white + self.across[:, group.start :] @ push
        return {**values, STRUCTURE: values[STRUCTURE] + self.across @ (found - along)}

    def _groups(self) -> list[slice]:
        return [slice(first, end) for first, end in pairwise(self.bounds)]

    def _begun(
        self, values: dict[str, Array]
    ) -> tuple[
        LogNormalSky,
        Float[Array, " directions"],
        Float[Array, " directions"],
        Float[Array, " unknowns"],
    ]:
        """The sky with the sites' C_ell, k, V^T (x - u*), and u* + V_0 x_0.

        Where C_ell is not that of the mode, u* is what keeps the logarithm as it is there.
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
        self,
        sky: LogNormalSky,
        white: Float[Array, " unknowns"],
        scales: Float[Array, " directions"],
        group: slice,
    ) -> Float[Array, " free"]:
        """Steps along a group and all stiffer ones that bring the map nearer to the mode's."""
        off = sky.modes(white) - self.modes
        return -scales[group.start :] * (self.down[group.start :] @ off)


def straight_coordinates(
    mode: LogNormalMode,
    power_law: tuple[float, float] | None = None,
    covariance: Float[np.ndarray, "2 2"] | None = None,
) -> Whitening:
    """Make the coordinates about a mode.

    Parameters
    ----------
    mode : LogNormalMode
    power_law : (float, float), optional
        ln A and the tilt of the mode's C_ell, where they are unknowns as well.
    covariance : (2, 2) array, optional
        Of these.

    Returns
    -------
    Whitening
        Of the site ``structure``, behind ``amplitude`` and ``tilt`` where they are unknowns; in
        JAX's arrays.
    """
    strength, vectors = np.linalg.eigh(mode.lower @ mode.lower.T)
    stiff = slice(int(np.searchsorted(strength, STIFF)), None)
    across = np.ascontiguousarray(vectors[:, stiff])
    pulled = (across.T @ mode.jacobian.T) @ mode.information.matrix
    down = pulled / (strength[stiff] - 1.0)[:, None]
    root = vectors / np.sqrt(strength)[None]
    left_open = ((mode.sky.root()[:, None] * root)[: mode.sky.n_modes] ** 2).sum() / (4.0 * np.pi)
    if covariance is not None:  # C_ell moves the logarithm, too, where it is not known
        slopes = mode.sky.power_law_slopes()[:, 1:]
        left_open += np.einsum("im,ij,jm->m", slopes, covariance, slopes).max()
    bounds = _bounds(strength[stiff], GAIN**2 * left_open)
    chart = StraightSky(mode.sky, mode.white, mode.modes, across, down, bounds)
    log_det, mean = -np.log(np.diagonal(mode.lower)).sum(), mode.white
    sites: tuple[tuple[str, tuple[int, ...]], ...] = ((STRUCTURE, (mode.sky.size,)),)
    if power_law is not None:
        own = np.linalg.cholesky(covariance)
        log_det = log_det + np.log(np.diagonal(own)).sum()
        mean, root = np.concatenate([power_law, mean]), block_diag(own, root)
        sites = ((AMPLITUDE, ()), (TILT, ()), *sites)
    return on_device(Whitening(mean, root, np.asarray(log_det), sites, chart))


def _bounds(strength: Float[np.ndarray, " directions"], gain: float) -> tuple[int, ...]:
    """Where groups begin in which curvatures differ by less than the squared gain."""
    if not len(strength):
        return (0,)
    group = np.floor(np.log(strength / STIFF) / max(np.log(1.0 / gain), LEAST)).astype(int)
    first = np.flatnonzero(np.diff(group, prepend=-1))
    return (*first.tolist(), len(strength))
