"""The directions that beams are sampled in, and interpolation between them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Complex, Float, Inexact

from lusee_bayes.core.errors import InputError
from lusee_bayes.core.lazy import healpy
from lusee_bayes.instrument.beams.grid import HemisphereGrid
from lusee_bayes.instrument.beams.gridded import on_grid
from lusee_bayes.instrument.beams.healpix_rings import from_rings

# of angles in degrees that are written with few digits
ANGLE_TOLERANCE = 1e-6


@dataclass(frozen=True)
class Directions:
    """A grid of theta and phi, or HEALPix pixels, above the horizon.

    Programs differ in whether a direction on the horizon counts as above it: none is used, and the
    last step to the horizon is extrapolated.

    Attributes
    ----------
    theta : (theta,) array or None
        In radians, below pi / 2; None for HEALPix.
    n_phi : int
        Azimuths 2 pi k / n_phi.
    nside : int
        Of the pixels; 0 for a grid.
    """

    theta: Float[np.ndarray, " theta"] | None
    n_phi: int
    nside: int = 0

    @classmethod
    def of(cls, theta_deg: Any, phi_deg: Any, shape: tuple[int, ...], path: str) -> Directions:
        """Return the directions of the last axes of arrays.

        Parameters
        ----------
        theta_deg, phi_deg : array or None
            See :func:`.sampled_beams`.
        shape : tuple of int
            Of the last axes.
        path : str
            For messages.

        Raises
        ------
        InputError
            If angles do not cover the hemisphere, or neither they nor pixels fit the shape.
        """
        if (theta_deg is None) != (phi_deg is None):
            raise InputError(f"{path}: give both theta_deg and phi_deg, or neither for HEALPix")
        if theta_deg is None or phi_deg is None:
            if len(shape) != 1 or not healpy.isnpixok(shape[0]):
                raise InputError(
                    f"{path}: directions of shape {shape} are no HEALPix map of 12 NSIDE^2 pixels; "
                    "give theta_deg and phi_deg for a grid"
                )
            return cls(None, 0, healpy.npix2nside(shape[0]))
        theta, phi = (np.atleast_1d(np.asarray(x, dtype=np.float64)) for x in (theta_deg, phi_deg))
        if shape != (len(theta), len(phi)):
            raise InputError(
                f"{path}: directions of shape {shape}, expected {len(theta)} theta x {len(phi)} phi"
            )
        used = theta[theta < 90.0 - ANGLE_TOLERANCE]
        steps = np.diff(theta)
        covers = len(used) >= 4 and (steps > 0.0).all() and theta[0] >= 0.0
        if not covers or max(theta[0], 90.0 - used[-1]) > steps[: len(used)].max():
            raise InputError(
                f"{path}: theta_deg runs from {theta[0]:g} to {theta[-1]:g} in {len(theta)} steps, "
                "expected growing angles from the zenith (0) to the horizon (90), four at least"
            )
        n = len(phi) - int(len(phi) > 1 and abs(phi[-1] - 360.0) < ANGLE_TOLERANCE)
        if np.abs(phi[:n] - 360.0 * np.arange(n) / n).max() > ANGLE_TOLERANCE:
            raise InputError(
                f"{path}: phi_deg runs from {phi[0]:g} to {phi[-1]:g} in {len(phi)} steps, "
                f"expected 360 k / n from East towards North, such as 0, {360.0 / n:g}, ..."
            )
        return cls(np.radians(used), n)

    @property
    def text(self) -> str:
        """What they are, in words."""
        if self.theta is None:
            return f"HEALPix pixels of NSIDE {self.nside}"
        return f"{len(self.theta)} theta x {self.n_phi} phi"

    def above(self, values: np.ndarray, what: str) -> np.ndarray:
        """Return the values in these directions of those in all directions that were given.

        Raises
        ------
        InputError
            If one is not finite.
        """
        kept = values
        if self.theta is not None:
            kept = values[..., : len(self.theta), : self.n_phi]
        else:
            # pixels below the horizon are zeros, whatever a file has there
            theta, _ = healpy.pix2ang(self.nside, np.arange(values.shape[-1]))
            kept = np.where(theta < np.pi / 2.0, values, 0.0)
        bad = ~np.isfinite(kept)
        if bad.any():
            raise InputError(
                f"{what} holds NaN or infinity in {int(bad.sum())} of {bad.size} places above the "
                "horizon"
            )
        return kept

    def quadrature(self, lmax: int) -> HemisphereGrid:
        """Return nodes that resolve both these directions and harmonics up to ``lmax``."""
        rings = 2 * self.nside if self.theta is None else len(self.theta)
        azimuths = 4 * self.nside if self.theta is None else self.n_phi
        return HemisphereGrid.gauss_legendre(2 * max(rings, lmax + 1), max(azimuths, 2 * lmax + 2))

    def scalars_on(
        self, values: Inexact[np.ndarray, "n *directions"], grid: HemisphereGrid, turn_deg: float
    ) -> Inexact[np.ndarray, "n theta phi"]:
        """Interpolate functions, turned from East towards North, to a grid."""
        if self.theta is None:
            return from_rings(values, grid.theta, grid.phi - np.radians(turn_deg))
        turned = [on_grid(one.astype(np.complex128), self.theta, grid, turn_deg) for one in values]
        return np.stack(turned) if np.iscomplexobj(values) else np.stack(turned).real

    def vectors_on(
        self,
        e_theta: Complex[np.ndarray, "n *directions"],
        e_phi: Complex[np.ndarray, "n *directions"],
        grid: HemisphereGrid,
        turn_deg: float,
    ) -> tuple[Complex[np.ndarray, "n theta phi"], Complex[np.ndarray, "n theta phi"]]:
        """Interpolate theta and phi components of vectors, turned likewise, to a grid.

        Between pixels the components along three fixed axes are interpolated: those along theta
        and phi have no value at the zenith.
        """
        if self.theta is not None:
            return (
                self.scalars_on(e_theta, grid, turn_deg),
                self.scalars_on(e_phi, grid, turn_deg),
            )
        theta, phi = healpy.pix2ang(self.nside, np.arange(e_theta.shape[-1]))
        along = [a * e_theta + b * e_phi for a, b in zip(*_axes(theta, phi), strict=True)]
        own_phi = grid.phi - np.radians(turn_deg)
        fixed = [from_rings(one, grid.theta, own_phi) for one in along]
        back = _axes(grid.theta[:, None], own_phi[None])
        turned = [sum(a * one for a, one in zip(axis, fixed, strict=True)) for axis in back]
        return turned[0], turned[1]


def _axes(theta: np.ndarray, phi: np.ndarray) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """East, North and up components of the unit vectors along theta and phi."""
    zero = np.zeros(np.broadcast_shapes(theta.shape, phi.shape))
    return (
        [np.cos(theta) * np.cos(phi), np.cos(theta) * np.sin(phi), zero - np.sin(theta)],
        [zero - np.sin(phi), zero + np.cos(phi), zero],
    )
