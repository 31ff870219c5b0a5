"""What the strength of a sky's texture may depend on: windows in ell, covariates, cells."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Complex, Float
from scipy import sparse

from lusee_bayes.core.checks import require_positive
from lusee_bayes.core.harmonics import n_modes, synthesis_matrix
from lusee_bayes.core.lazy import healpy
from lusee_bayes.core.sphere_grid import SphereGrid
from lusee_bayes.sky.learned_spectrum import PIVOT
from lusee_bayes.sky.template import EmbeddedTemplate

# NSIDE at which templates are analysed and smoothed
TEMPLATE_NSIDE, TEMPLATE_LMAX = 64, 96
# a template is smoothed to this angle over a band's ell, and to this one, in degrees (FWHM)
RESOLUTION_DEG, FINEST_DEG = 60.0, 4.0
# how the texture's variance goes with the template: as its square if fluctuations are relative
TEMPLATE_POWER, POWER_WIDTH = 2.0, 1.0
# half width of the plane in degrees, and how much stronger it may be there
PLANE_DEG, PLANE_WIDTH = 4.0, 1.5
# how much flatter the spectrum may be where the template is bright, and in the plane
TILTS_WIDTH = 0.5
# largest ell of the smooth field of ln v, and its standard deviation for each ell
FIELD_LMAX, FIELD_WIDTH = 4, 0.4
# NSIDE of the cells
CELLS_NSIDE = 4
N_CELLS = 12 * CELLS_NSIDE**2
# a band's grid resolves the plane and the cells: exact to twice this degree at least
LEAST_BAND = 24


@dataclass(frozen=True)
class Band:
    """A window in ell, and what the strength of the sky in it depends on.

    Attributes
    ----------
    window : (ells,) array
        w_j.
    grid : SphereGrid
        Up to the window's last ell.
    covariates : (points, covariates) array
    cells : (points, cells) sparse array
        Interpolation between cells.
    """

    window: Float[np.ndarray, " ells"]
    grid: SphereGrid
    covariates: Float[np.ndarray, "points covariates"]
    cells: sparse.csr_array

    @classmethod
    def of(
        cls,
        window: Float[np.ndarray, " ells"],
        template: SmoothedTemplate,
        transparent: SmoothedTemplate,
    ) -> Band:
        """Make the band of a window."""
        top = int(np.flatnonzero(window)[-1])
        grid = SphereGrid.of(top, max((3 * top + 1) // 2, LEAST_BAND))
        theta, phi = grid.directions()
        fwhm = float(np.hypot(RESOLUTION_DEG / _middle(window), FINEST_DEG))
        seen, clear = (each.log(fwhm, theta, phi) for each in (template, transparent))
        latitude = 90.0 - np.degrees(theta)
        thickness = PLANE_DEG**2 + (fwhm / np.sqrt(8.0 * np.log(2.0))) ** 2
        plane = np.exp(-0.5 * latitude**2 / thickness)
        field = synthesis_matrix(theta, phi, FIELD_LMAX)[:, 1:] * np.sqrt(4.0 * np.pi)
        near, weight = healpy.get_interp_weights(CELLS_NSIDE, theta, phi)
        at = np.tile(np.arange(len(theta)), 4)
        cells = sparse.csr_array((weight.ravel(), (at, near.ravel())), (len(theta), N_CELLS))
        x = np.log((_middle(window) + 1.0) / PIVOT)
        tilts = x * np.column_stack([seen, plane])
        covariates = np.column_stack([seen, clear - seen, plane, tilts, field])
        return cls(window, grid, covariates, cells)


def windows(lmax: int) -> Float[np.ndarray, "bands ells"]:
    """Return windows an octave wide whose squares add up to one for ell > 0, the lowest first.

    Parameters
    ----------
    lmax : int
        Where the last one ends.
    """
    ell = np.arange(1.0, lmax + 1.0)
    n = max(1, int(np.floor(np.log2(lmax / 1.5))) + 1)
    edges = lmax / 2.0 ** np.arange(n - 1, 0, -1)
    # the share of each ell that is below an edge, falling over an octave
    octaves = np.clip(np.log2(ell[None] / edges[:, None]), 0.0, 1.0)
    below = np.cos(0.5 * np.pi * octaves) ** 2
    shares = np.diff(np.concatenate([np.zeros((1, lmax)), below, np.ones((1, lmax))]), axis=0)
    found = np.zeros((n, lmax + 1))
    found[:, 1:] = np.sqrt(np.where(shares > 1e-12, shares, 0.0))
    return found


def _middle(window: Float[np.ndarray, " ells"]) -> float:
    """Root mean square ell of a window's modes."""
    ell = np.arange(len(window))
    weight = window**2 * (2.0 * ell + 1.0)
    return float(np.sqrt((weight * ell**2).sum() / weight.sum()))


@dataclass(frozen=True)
class SmoothedTemplate:
    """A positive template at any resolution.

    Attributes
    ----------
    alm : (alms,) array
        Its complex coefficients, in K.
    mean_log : float
        Mean of its logarithm.
    """

    alm: Complex[np.ndarray, " alms"]
    mean_log: float

    @classmethod
    def of(cls, template: EmbeddedTemplate) -> SmoothedTemplate:
        """Analyse a template."""
        pixels = template.pixels(TEMPLATE_NSIDE)
        alm = healpy.map2alm(pixels, lmax=TEMPLATE_LMAX, iter=3)
        return cls(alm, float(np.log(pixels).mean()))

    def log(
        self,
        fwhm_deg: float,
        theta: Float[np.ndarray, " points"],
        phi: Float[np.ndarray, " points"],
    ) -> Float[np.ndarray, " points"]:
        """ln of the smoothed template less its mean, in given directions."""
        beam = healpy.gauss_beam(np.radians(fwhm_deg), lmax=TEMPLATE_LMAX)
        alm = healpy.almxfl(self.alm, beam)
        smooth = healpy.alm2map(alm, TEMPLATE_NSIDE, lmax=TEMPLATE_LMAX)
        require_positive("the smoothed template", smooth)
        return np.log(healpy.get_interp_val(smooth, theta, phi)) - self.mean_log


def expected_covariates() -> tuple[
    Float[np.ndarray, " covariates"], Float[np.ndarray, " covariates"]
]:
    """Return centre and width of what is expected of the covariates' coefficients."""
    ell = np.sqrt(np.arange(1, n_modes(FIELD_LMAX))).astype(int)
    named = [POWER_WIDTH, POWER_WIDTH, PLANE_WIDTH, TILTS_WIDTH, TILTS_WIDTH]
    width = np.concatenate([named, FIELD_WIDTH / np.sqrt(2.0 * ell + 1.0)])
    centre = np.zeros(len(width))
    centre[0] = TEMPLATE_POWER
    return centre, width
