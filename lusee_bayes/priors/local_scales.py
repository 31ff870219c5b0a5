"""A Gaussian sky whose strength varies with direction and is learned.

::

    m = T + s_T x_1 T + s_0 x_0 Y_00 + sum_q x_q (T_q - T) + sum_k s_k x_k o(k)
          + f sum_b x_b y(b) + sum_i g_i x_i D(i) + R sum_j w_j P [sqrt(v_j) n_j]

T is a template; its scale and the monopole have wide priors. With surveys of the sky, T is their
mean, and T_q are the surveys and the embedded template. o(k) are named extended objects, y(b) the
point sources of the catalogue and, without surveys, D(i) broad discs all over the sky. n_j is
white noise on the sphere, v_j(p) a positive field, P the harmonic analysis, w_j windows in ell an
octave wide with sum_j w_j^2 = 1, and R = diag(C_ell^1/2). If all v_j = 1, the last term is an
isotropic field with spectrum C_ell. Its covariance is R sum_j w_j W(v_j) w_j R, where the matrix
W(v) multiplies by v. The logarithm of v_j is a sum of covariates: the template at the band's
resolution, the same without absorption, the Galactic plane, a smooth field of low ell, and
15-degree cells for compact departures, whose factors have a power-law tail.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from jaxtyping import Complex, Float, Int
from scipy import sparse

from lusee_bayes.core import checks, sphere_grid
from lusee_bayes.core.arrays import Ells, Modes, ModesMatrix, Vector
from lusee_bayes.core.harmonics import n_modes, per_mode, sum_over_m, synthesis_matrix
from lusee_bayes.core.lazy import healpy
from lusee_bayes.core.linalg import checked_cholesky, scaled
from lusee_bayes.priors.families import Hyperprior, Member, Parameters, PriorFamily, spectrum_basis
from lusee_bayes.priors.surveys import Survey
from lusee_bayes.sky import galaxy, sky_source
from lusee_bayes.sky.prior import PIVOT, DensePrior

# arrays that recur
Covariates = Float[np.ndarray, " covariates"]
OfSizes = Float[np.ndarray, "sizes n"]
Strengths = list[Float[np.ndarray, " _"]]
# frequency in MHz at which the Galaxy is nearly transparent
TRANSPARENT_MHZ = 50.0
# standard deviations of the template's scale, and of the monopole in units of the template's
SCALE_WIDTH = MONOPOLE_WIDTH = 1.0
# of the weights of surveys and of the embedded template
WEIGHT_WIDTH = 1.0
# discs (FWHM) for spurs and clouds that nothing else names, and their usual strength over the
# mean of the sky. Over 30 degrees GSM2008 departs from the template by 10 % of its mean, ULSA's
# sky by 1 %. The last is the width of ln g_i^2
DISCS_NSIDE, DISC_DEG, DISC_WIDTH, DISCS_WIDTH = 2, 30.0, 0.03, 1.0
# C_ell of white errors, which every survey has: 0.1 % of the mean up to ell = 31, over C_0
WHITE = 1e-6 / 1024
# the same of any sky, 3e-5 of its mean: S of a smooth one would be singular to rounding
LEAST_WHITE = 1e-12
# of ln f^2: so wide that the data decide whether the catalogue's sources exist at all
SOURCES_WIDTH = 3.0
# NSIDE at which templates are analysed and smoothed
TEMPLATE_NSIDE, TEMPLATE_LMAX = 64, 96
# a band smooths the template by RESOLUTION_DEG / ell and FINEST_DEG in quadrature (FWHM)
RESOLUTION_DEG, FINEST_DEG = 60.0, 4.0
# the texture's variance is this power of the template: the square if fluctuations are relative
TEMPLATE_POWER, POWER_WIDTH = 2.0, 1.0
# half width of the plane in degrees, and how much stronger the texture may be there
PLANE_DEG, PLANE_WIDTH = 4.0, 1.5
# how much flatter the spectrum may be where the template is bright, and in the plane
TILTS_WIDTH = 0.5
# largest ell of the smooth field of ln v, and its standard deviation for each ell
FIELD_LMAX, FIELD_WIDTH = 4, 0.4
# NSIDE of the cells
CELLS_NSIDE = 4
N_CELLS = 12 * CELLS_NSIDE**2
# a band's grid must resolve the plane and the cells: it is exact to at least twice this degree
LEAST_BAND = 24


@dataclass(frozen=True)
class Band:
    """A window in ell, and the covariates of the sky's strength in it.

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

    window: Ells
    grid: sphere_grid.SphereGrid
    covariates: Float[np.ndarray, "points covariates"]
    cells: sparse.csr_array

    @classmethod
    def of(cls, window: Ells, frequency_mhz: float) -> Band:
        """Make the band of a window."""
        top = int(np.flatnonzero(window)[-1])
        grid = sphere_grid.SphereGrid.of(top, max((3 * top + 1) // 2, LEAST_BAND))
        theta, phi = grid.directions()
        fwhm = float(np.hypot(RESOLUTION_DEG / _middle(window), FINEST_DEG))
        # the template, and the same sky nearly without absorption
        frequencies = frequency_mhz, max(TRANSPARENT_MHZ, frequency_mhz)
        seen, clear = (smoothed_log(mhz, fwhm, theta, phi) for mhz in frequencies)
        latitude = 90.0 - np.degrees(theta)
        thickness = PLANE_DEG**2 + (fwhm / np.sqrt(8.0 * np.log(2.0))) ** 2
        plane = np.exp(-0.5 * latitude**2 / thickness)
        field = synthesis_matrix(theta, phi, FIELD_LMAX)[:, 1:] * np.sqrt(4.0 * np.pi)
        near, weight = healpy.get_interp_weights(CELLS_NSIDE, theta, phi)
        at = np.tile(np.arange(len(theta)), 4)
        cells = sparse.csr_array((weight.ravel(), (at, near.ravel())), (len(theta), N_CELLS))
        tilts = np.log((_middle(window) + 1.0) / PIVOT) * np.column_stack([seen, plane])
        return cls(window, grid, np.column_stack([seen, clear - seen, plane, tilts, field]), cells)


def windows(lmax: int) -> Float[np.ndarray, "bands ells"]:
    """Return windows an octave wide whose squares add up to one for ell > 0, the lowest first.

    Parameters
    ----------
    lmax : int
        Last ell of the last window.
    """
    ell, n = np.arange(1.0, lmax + 1.0), max(1, int(np.floor(np.log2(lmax / 1.5))) + 1)
    edges = lmax / 2.0 ** np.arange(n - 1, 0, -1)
    # the fraction of each ell that is below an edge, which falls over an octave
    below = np.cos(0.5 * np.pi * np.clip(np.log2(ell[None] / edges[:, None]), 0.0, 1.0)) ** 2
    shares = np.diff(np.concatenate([np.zeros((1, lmax)), below, np.ones((1, lmax))]), axis=0)
    bands = np.zeros((n, lmax + 1))
    bands[:, 1:] = np.sqrt(np.where(shares > 1e-12, shares, 0.0))
    return bands


def _middle(window: Ells) -> float:
    """Root mean square ell of a window's modes."""
    ell = np.arange(len(window))
    weight = window**2 * (2.0 * ell + 1.0)
    return float(np.sqrt((weight * ell**2).sum() / weight.sum()))


@lru_cache(maxsize=4)
def _template(frequency_mhz: float) -> tuple[Complex[np.ndarray, " alms"], float]:
    """The embedded diffuse sky, without random structure, in K, and the mean of its logarithm."""
    pixels = galaxy.galaxy_map(frequency_mhz, TEMPLATE_NSIDE, seed=None)
    return healpy.map2alm(pixels, lmax=TEMPLATE_LMAX, iter=3), float(np.log(pixels).mean())


def smoothed_log(frequency_mhz: float, fwhm_deg: float, theta: Vector, phi: Vector) -> Vector:
    """ln of the smoothed template minus the mean logarithm, in given directions."""
    alm, mean_log = _template(frequency_mhz)
    alm = healpy.almxfl(alm, healpy.gauss_beam(np.radians(fwhm_deg), lmax=TEMPLATE_LMAX))
    smooth = healpy.alm2map(alm, TEMPLATE_NSIDE, lmax=TEMPLATE_LMAX)
    checks.require_positive("the smoothed template", smooth)
    return np.log(healpy.get_interp_val(smooth, theta, phi)) - mean_log


def _discs(lmax: int) -> Float[np.ndarray, "discs modes"]:
    """Gaussian discs at the centres of large HEALPix pixels, with a peak of one."""
    directions = healpy.pix2ang(DISCS_NSIDE, np.arange(12 * DISCS_NSIDE**2))
    fwhm = np.radians(DISC_DEG)
    area = 2.0 * np.pi * fwhm**2 / (8.0 * np.log(2.0))
    return area * per_mode(healpy.gauss_beam(fwhm, lmax)) * synthesis_matrix(*directions, lmax)


def hyperprior_of(centre: Parameters, width: Parameters, n_discs: int) -> Hyperprior:
    """The prior of all parameters, given that of the spectrum's."""
    ell = np.sqrt(np.arange(1, n_modes(FIELD_LMAX))).astype(int)
    named = [POWER_WIDTH, POWER_WIDTH, PLANE_WIDTH, TILTS_WIDTH, TILTS_WIDTH]
    of_field = FIELD_WIDTH / np.sqrt(2.0 * ell + 1.0)
    widths = np.concatenate([width, [SOURCES_WIDTH], [DISCS_WIDTH] * n_discs, named, of_field])
    others = np.zeros(len(widths) - len(centre))
    others[1 + n_discs] = TEMPLATE_POWER
    return Hyperprior(np.concatenate([centre, others]), widths, N_CELLS)


@dataclass(frozen=True)
class LocalScales(PriorFamily):
    """The family of priors of the module's equation.

    Attributes
    ----------
    mean : (modes,) array
        T, in K.
    wide : (modes, wide) array
        Template, monopole, weights of surveys and extended objects, times their standard
        deviations, in K.
    sized : (modes, sized) array
        Catalogued sources and discs, in K, whose strengths f and g_i are learned.
    size_of : (sized,) array
        Which strength is whose.
    spectrum : (ells, parameters) array
        ln C_ell as a linear function of its parameters.
    bands : tuple of Band
    white : float
        C_ell of white errors of surveys, in K^2.
    """

    mean: Modes
    wide: Float[np.ndarray, "modes wide"]
    sized: Float[np.ndarray, "modes sized"]
    size_of: Int[np.ndarray, " sized"]
    spectrum: Float[np.ndarray, "ells spectrum"]
    bands: tuple[Band, ...]
    hyperprior: Hyperprior
    white: float

    def at(self, parameters: Parameters) -> LocalScalesMember:
        return LocalScalesMember(self, *self._split(parameters))

    def averaged(self, parameters, covariance):
        member = self.at(parameters)
        ells, sizes, covariates, _ = self._split(np.eye(len(parameters)))
        strengths = []
        for band, strength in zip(self.bands, member.strengths, strict=True):
            weight = band.window**2 * (2.0 * np.arange(len(band.window)) + 1.0)
            spectrum = (weight / weight.sum()) @ self.spectrum @ ells
            rows = spectrum[None] + band.covariates @ covariates
            if self.white:  # the data only have an upper limit of the level, which is fitted later
                rows[:, 0] = 0.0
            spread = np.einsum("ij,ij->i", rows @ covariance, rows)
            strengths.append(strength * np.exp(0.5 * spread))
        sizes = np.exp(member.sizes + 0.5 * np.einsum("ij,jk,ik->i", sizes, covariance, sizes))
        return _covariance(self, sizes, _texture(self, member.spectrum, strengths))

    def prior(self, covariance):
        return DensePrior(checked_cholesky("the prior covariance", covariance), mean=self.mean)

    def start_from(self, coarse, parameters):
        power, *others = coarse._split(parameters)
        return np.concatenate([power, np.zeros(self.spectrum.shape[1] - len(power)), *others])

    @property
    def n_sizes(self) -> int:
        """Number of strengths f and g_i."""
        return int(self.size_of.max(initial=0)) + 1

    def summed(self, columns: Float[np.ndarray, "sized n"]) -> OfSizes:
        """Sum over the columns of each strength."""
        return np.equal.outer(np.arange(self.n_sizes), self.size_of) @ columns

    def _split(self, parameters: np.ndarray) -> list[np.ndarray]:
        """Parameters of the spectrum, the sizes, the covariates and the cells."""
        sizes = self.spectrum.shape[1], self.n_sizes, self.bands[0].covariates.shape[1]
        return np.split(parameters, np.cumsum(sizes))


def _covariance(family: LocalScales, sizes: Vector, texture: ModesMatrix) -> ModesMatrix:
    columns = np.concatenate([family.wide, np.sqrt(sizes)[family.size_of] * family.sized], axis=1)
    total = columns @ columns.T + texture
    total[np.diag_indices_from(total)] += max(family.white, LEAST_WHITE * family.mean[0] ** 2)
    return total


def _texture(family: LocalScales, spectrum: Ells, strengths: Strengths) -> ModesMatrix:
    total = np.zeros((len(family.mean),) * 2)
    for band, strength in zip(family.bands, strengths, strict=True):
        scale = _scale(band, spectrum)
        part = band.grid.product_matrix(strength.reshape(band.grid.shape))
        total[: len(scale), : len(scale)] += scaled(part, scale, overwrite=True)
    return total


def _scale(band: Band, spectrum: Ells) -> Modes:
    """w_j C_ell^1/2 of every mode up to the band's last ell."""
    ells = slice(band.grid.lmax + 1)
    return per_mode(band.window[ells] * np.sqrt(spectrum[ells]))


@dataclass(frozen=True)
class LocalScalesMember(Member):
    """One prior of :class:`LocalScales`.

    Attributes
    ----------
    family : LocalScales
    power, sizes, coefficients, factors : arrays
        Parameters of the spectrum, the sizes, the covariates and the cells.
    """

    family: LocalScales
    power: Float[np.ndarray, " spectrum"]
    sizes: Float[np.ndarray, " sizes"]
    coefficients: Covariates
    factors: Float[np.ndarray, " cells"]

    @cached_property
    def spectrum(self) -> Ells:
        """C_ell, in K^2."""
        return np.exp(self.family.spectrum @ self.power)

    @cached_property
    def strengths(self) -> Strengths:
        """v_j of every band."""
        return [
            np.exp(band.covariates @ self.coefficients + band.cells @ self.factors)
            for band in self.family.bands
        ]

    @cached_property
    def texture(self) -> ModesMatrix:
        """Covariance of the last term of the module's equation, in K^2."""
        return _texture(self.family, self.spectrum, self.strengths)

    @property
    def covariance(self):
        return _covariance(self.family, np.exp(self.sizes), self.texture)

    def traces(self, matrix):
        family = self.family
        ells = 0.5 * sum_over_m(np.einsum("ij,ij->i", self.texture, matrix))
        sized = 0.5 * np.einsum("is,ij,js->s", family.sized, matrix, family.sized, optimize=True)
        fields = []
        for band in family.bands:
            scale = _scale(band, self.spectrum)
            n = len(scale)
            fields.append(band.grid.diagonal(scale[:, None] * matrix[:n, :n] * scale)[None])
        return self._gathered(ells[:, None], family.summed(sized[:, None]), fields)[:, 0]

    def forms(self, columns):
        family = self.family
        ells = 0.5 * sum_over_m((columns * (self.texture @ columns)).T).T
        sizes, fields = family.summed(0.5 * (family.sized.T @ columns) ** 2), []
        for band in family.bands:
            scale = _scale(band, self.spectrum)
            fields.append(band.grid.synthesise((scale[:, None] * columns[: len(scale)]).T) ** 2)
        return self._gathered(ells, sizes, fields)

    def _gathered(
        self, ells: Float[np.ndarray, "ells n"], sizes: OfSizes, fields: list[np.ndarray]
    ) -> Float[np.ndarray, "parameters n"]:
        """Derivatives by the parameters, from those by ln C_ell, ln f^2, ln g_i^2 and v_j."""
        family = self.family
        covariates = np.zeros((len(self.coefficients), sizes.shape[1]))
        cells = np.zeros((N_CELLS, sizes.shape[1]))
        for band, strength, field in zip(family.bands, self.strengths, fields, strict=True):
            area = 0.5 * np.repeat(np.asarray(band.grid.weights), band.grid.n_phi) * strength
            by_point = field.reshape(len(field), -1)
            covariates += (by_point @ (band.covariates * area[:, None])).T
            cells += band.cells.multiply(area[:, None]).T @ by_point.T
        sizes = np.exp(self.sizes)[:, None] * sizes
        return np.concatenate([family.spectrum.T @ ells, sizes, covariates, cells])


def embedded_local_scales(
    frequency_mhz: float,
    lmax: int,
    sources: tuple[galaxy.PointSource, ...] = galaxy.BRIGHT_SOURCES,
    surveys: Sequence[Survey] = (),
) -> LocalScales:
    """Make the family whose template is the embedded diffuse sky, or the mean of surveys.

    Parameters
    ----------
    frequency_mhz : float
    lmax : int
    sources : tuple of PointSource
        The catalogue of possible sources.
    surveys : sequence of Survey
        At this frequency, with the same lmax.
    """
    mean = np.asarray(sky_source.galaxy_sky(frequency_mhz, lmax, seed=None, sources=()).modes)
    constant, level = np.arange(len(mean)) == 0, mean[0] / np.sqrt(4.0 * np.pi)
    # these may be brighter or darker than their surroundings
    extended = [level * one.strength * one.modes(lmax) for one in galaxy.EXTENDED_OBJECTS]
    scale, zero, weights = SCALE_WIDTH * mean, MONOPOLE_WIDTH * mean * constant, []
    discs = DISC_WIDTH * level * _discs(lmax).T
    if surveys:
        filled = [survey.sharpened(mean) for survey in surveys]
        weights, mean = [*filled, mean], np.mean(filled, axis=0)
        weights = [WEIGHT_WIDTH * (one * (mean[0] / one[0]) - mean) for one in weights]
        stds = np.array([[s.scale_std, np.sqrt(4.0 * np.pi) * s.zero_std] for s in surveys])
        of_scale, of_zero = np.sqrt((stds**2).sum(axis=0)) / len(surveys)
        scale, zero, discs = of_scale * mean, of_zero * constant, discs[:, :0]
    wide = np.stack([scale, zero, *weights, *extended], axis=1)
    of_sources = np.reshape([s.modes(frequency_mhz, lmax) for s in sources], (-1, len(mean))).T
    spectrum, *expected = spectrum_basis(np.exp(_template(frequency_mhz)[1]), lmax)
    bands = tuple(Band.of(window, frequency_mhz) for window in windows(lmax))
    white = WHITE * mean[0] ** 2 if surveys else 0.0
    sized = np.concatenate([of_sources, discs], axis=1)
    size_of = np.concatenate([np.zeros(of_sources.shape[1], int), 1 + np.arange(discs.shape[1])])
    hyperprior = hyperprior_of(*expected, n_discs=discs.shape[1])
    return LocalScales(mean, wide, sized, size_of, spectrum, bands, hyperprior, white)
