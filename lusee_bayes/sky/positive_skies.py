"""Positive skies of several frequencies: templates times the exponential of Gaussian fields. ::

    ln m_f = ln T_f + w phi_f,    phi_f = a_0 + a_1 ln x + a_2 ln^2 x - a_3 y^-2.1 + r_f,
    x = nu / nu_ref,    y = nu / nu_turnover,

with a template T_f at every frequency, a_0 its level at nu_ref, a_1 the change of its spectral
index, a_2 that of its curvature, a_3 the change of the optical depth of ionised gas at nu_turnover
(Altenhoff et al. 1960), and a residual r_f of every channel; all of them vary over the sky and have
no unit. The weight w is their strength from place to place, the same at all frequencies. The
exponent of a channel is linear in them, and its sky is positive. About any exponent phi, ::

    dm_f = W d(phi),    W_ij = int y_i w T_f exp(w phi) y_j dOmega.

The expected spectrum of every field, and of every channel's residual, is a power law, ::

    C_ell = A^2 ((ell + 1) / 10)^tilt,    ell > 0;

the mean over the sky has a separate width. A and tilt may be learned: ln A and tilt are normal
around their expected values.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import equinox as eqx
import numpy as np
from jaxtyping import Float

from lusee_bayes.core import checks, sphere_grid
from lusee_bayes.core.arrays import Array, Vector
from lusee_bayes.core.harmonics import n_modes
from lusee_bayes.sky.galaxy import FREE_FREE_SLOPE
from lusee_bayes.sky.prior import PIVOT
from lusee_bayes.sky.spectral_prior import SpectralPrior, require_names

Number = float | Float[Array, ""]
Exponents = Float[np.ndarray, "*batch columns"]
OfLaws = Float[np.ndarray, "laws ells"]
Pair = Float[np.ndarray, "2"]
# a brightness temperature in K, of Galactic theta and phi in radians
Template = Callable[[Vector, Vector], Vector]

# band limit of the grid: this multiple of the fields'
GRID = 3
# steps of Newton's method, each of which approaches the root; largest change of a parameter
NEWTON, REACH = 30, 2.0


def slopes(lmax: int) -> Float[np.ndarray, "2 ells"]:
    """Return the derivatives of ln C_ell^(1/2) with respect to ln A and the tilt."""
    return np.stack([np.ones(lmax + 1), 0.5 * np.log((np.arange(lmax + 1.0) + 1.0) / PIVOT)])


def matching_step(
    power: Vector, known: Vector, slope: Float[np.ndarray, "2 n"], away: Pair, narrow: Pair
) -> Pair:
    """Compute the change of ln A and the tilt that gives modes their expected power.

    At the maximum of the evidence sum u^2 = sum (1 - var u), in units of the prior, over all modes
    that a parameter changes (MacKay 1992, Neural Comp. 4, 415). It reaches further than a gradient.

    Parameters
    ----------
    power, known : (n,) array
        u^2, u being the posterior mean in units of the prior, and 1 - var u.
    slope : (2, n) array
        Derivatives of ln C^(1/2) with respect to ln A and the tilt.
    away, narrow : (2,) array
        Distance of the parameters from their expected values, and inverse prior variances.
    """
    step = np.zeros(2)
    for _ in range(NEWTON):
        scaled = power * np.exp(-2.0 * (step @ slope))
        curvature = 2.0 * (slope * np.maximum(scaled, known)) @ slope.T + np.diag(narrow)
        step = step + np.linalg.solve(curvature, slope @ (scaled - known) - narrow * (away + step))
    return np.clip(step, -REACH, REACH)


# factors of the fields in the logarithm: x is frequency / reference, y frequency / turnover
FIELDS = {
    "level": lambda x, y: np.ones_like(x),
    "index": lambda x, y: np.log(x),
    "curvature": lambda x, y: np.log(x) ** 2,
    "absorption": lambda x, y: -(y**FREE_FREE_SLOPE),
}
# lowest band limit of the fields' grid: unresolved parts of a template fold back into the map, at
# 96 by 5 % of it in the plane
FIELDS_GRID = 192


class PositiveSkies(eqx.Module):
    """Skies of all channels as functions of their exponents; see the module's equations.

    Attributes
    ----------
    frequencies_mhz : (channels,) array
    mixing : (channels, fields) array
        Factors of the fields in the logarithm.
    grid : SphereGrid
        Grid on which products are computed; its lmax is that of the exponents.
    levels : (channels, rings, phi) array
        T_f on the grid, in K.
    weight : (rings, phi) array
        w on the grid.
    sources : (channels, sources, modes) array
        F_fj y(n_j) of point sources to be added, in K.
    lmax : int
        Highest ell of the maps.
    names : tuple of str
        Names of the fields.
    """

    frequencies_mhz: Float[np.ndarray, " channels"]
    mixing: Float[np.ndarray, "channels fields"]
    grid: sphere_grid.SphereGrid
    levels: Float[np.ndarray, "channels rings phi"]
    weight: Float[np.ndarray, "rings phi"]
    sources: Float[np.ndarray, "channels sources modes"]
    lmax: int = eqx.field(static=True)
    names: tuple[str, ...] = eqx.field(static=True)

    @classmethod
    def of(
        cls,
        frequencies_mhz: Float[np.ndarray, " channels"],
        templates: Sequence[Template],
        lmax: int,
        names: tuple[str, ...] = tuple(FIELDS),
        *,
        sources: Float[np.ndarray, "channels sources modes"],
        weight: Template,
        lmax_fields: int,
        reference_mhz: float = 20.0,
        turnover_mhz: float = 5.0,
        band: int | None = None,
    ) -> PositiveSkies:
        """Create the skies from a template for every frequency.

        Parameters
        ----------
        frequencies_mhz : (channels,) array
            Frequencies in MHz.
        templates : sequence of callable
            T_f in K, in the same order; each a function of theta and phi, as ``weight``.
        lmax : int
            Highest ell of the maps.
        names : tuple of str
            Keys of ``FIELDS``.
        sources : (channels, sources, modes) array
            Coefficients of point sources, in K.
        weight : callable
            w, a function of Galactic theta and phi in radians.
        lmax_fields : int
            Highest ell of the exponents, at least ``lmax``.
        reference_mhz, turnover_mhz : float
            nu_ref and nu_turnover.
        band : int, optional
            Band limit of the grid; by default three times that of the exponents, and at least 192.

        Raises
        ------
        InputError
            For unknown names, fewer channels than fields, and templates or weights that are not
            positive everywhere.
        """
        frequencies = np.asarray(frequencies_mhz, dtype=np.float64)
        cls.require_fields(names, len(frequencies))
        finest = max(GRID * lmax_fields, FIELDS_GRID) if band is None else band
        grid = sphere_grid.SphereGrid.of(lmax_fields, finest)
        at = grid.directions()
        levels = np.stack([template(*at).reshape(grid.shape) for template in templates])
        checks.require_positive("the template", levels, "its logarithm is modelled")
        strength = weight(*at).reshape(grid.shape)
        checks.require_positive("the weight of the fields", strength)
        checks.require_shape("the sources", sources, (len(frequencies), None, n_modes(lmax)))
        x, y = frequencies / reference_mhz, frequencies / turnover_mhz
        mixing = np.stack([FIELDS[name](x, y) for name in names], axis=1)
        return cls(frequencies, mixing, grid, levels, strength, sources, lmax, names)

    @staticmethod
    def require_fields(names: tuple[str, ...], n_channels: int) -> None:
        """Refuse unknown fields, and more fields than channels."""
        require_names("field", "fields of the logarithm", names, FIELDS, n_channels)

    def coarser(self, lmax: int, lmax_fields: int) -> PositiveSkies:
        """Return the skies with fewer modes of maps and fields.

        Parameters
        ----------
        lmax, lmax_fields : int
            Highest ell of the maps, and of the exponents.
        """
        grid = sphere_grid.SphereGrid.of(lmax_fields, len(self.grid.theta) - 1)
        return replace(self, grid=grid, sources=self.sources[:, :, : n_modes(lmax)], lmax=lmax)

    @property
    def n_fields(self) -> int:
        """Number of modes of every field."""
        return n_modes(self.grid.lmax)

    def values(self, channel: int, exponent: Exponents) -> Float[np.ndarray, "*batch rings phi"]:
        """Compute T_f exp(w phi) on the grid, in K: positive, and infinite if phi is too large.

        Parameters
        ----------
        channel : int
        exponent : (..., modes) array
            phi.
        """
        with np.errstate(over="ignore"):
            return self.levels[channel] * np.exp(self.weight * self.grid.synthesise(exponent))

    def modes(self, channel: int, exponent: Exponents) -> Float[np.ndarray, "*batch modes"]:
        """Compute the sky without point sources: real packed coefficients, Galactic, in K.

        Parameters
        ----------
        channel : int
        exponent : (..., modes) array
            phi.
        """
        with np.errstate(invalid="ignore"):
            return self.grid.analyse(self.values(channel, exponent))[..., : n_modes(self.lmax)]

    def jacobian(self, channel: int, exponent: Vector) -> Float[np.ndarray, "modes columns"]:
        """Compute W, in K.

        Parameters
        ----------
        channel : int
        exponent : (modes,) array
            phi.
        """
        return self.grid.product_matrix(self.weight * self.values(channel, exponent), self.lmax)


# A of each field, whose rms over the sky is seven times that, and the width of its mean: a template
# accurate to a fifth (its mean to a half), indices to 0.06, optical depths to a fifth
EXPECTED = {
    "level": (0.03, 0.5),
    "index": (0.01, 0.2),
    "curvature": (0.005, 0.1),
    "absorption": (0.03, 0.5),
}
RESIDUAL, TILT = 0.003, -2.4
# prior standard deviations of ln A and the tilt
LOG_WIDTH, TILT_WIDTH = 1.5, 0.5


@dataclass(frozen=True)
class FieldLaws:
    """C_ell of all fields and residuals.

    Attributes
    ----------
    parameters : (fields + channels, 2) array
        ln A and tilt; the fields come first.
    means : (fields,) array
        Standard deviation of each field's mean over the sky.
    expected : (fields + channels, 2) array
        Expected values of the parameters before there are data.
    """

    parameters: Float[np.ndarray, "laws 2"]
    means: Float[np.ndarray, " fields"]
    expected: Float[np.ndarray, "laws 2"]

    @classmethod
    def of(cls, skies: PositiveSkies) -> FieldLaws:
        """Return the laws that are expected before there are data."""
        amplitudes, means = np.array([EXPECTED[name] for name in skies.names]).T
        levels = np.concatenate([amplitudes, np.full(len(skies.levels), RESIDUAL)])
        parameters = np.column_stack([np.log(levels), np.full(len(levels), TILT)])
        return cls(parameters, means, parameters)

    def prior(self, skies: PositiveSkies) -> SpectralPrior:
        """Return the prior of the fields: a spectral prior whose maps have no unit."""
        spectra = np.exp(2.0 * self.parameters @ slopes(skies.grid.lmax))
        fields = len(self.means)
        spectra[:fields, 0] = 4.0 * np.pi * self.means**2
        of_each = spectra[:fields], spectra[fields:]
        return SpectralPrior(skies.frequencies_mhz, skies.mixing, *of_each, skies.names)

    def matched(self, powers: OfLaws, known: OfLaws) -> FieldLaws:
        """Apply :func:`matching_step` to every law.

        Parameters
        ----------
        powers : (fields + channels, ells) array
            sum_m u^2, u being the posterior mean in units of the prior.
        known : (fields + channels, ells) array
            sum_m (1 - var u).
        """
        slope, parameters = slopes(powers.shape[1] - 1), self.parameters.copy()
        narrow = np.array([LOG_WIDTH, TILT_WIDTH]) ** -2.0
        for k, (power, left) in enumerate(zip(powers, known, strict=True)):
            # the mean over the sky has a fixed width
            of = slice(1 if k < len(self.means) else 0, None)
            away = self.parameters[k] - self.expected[k]
            parameters[k] += matching_step(power[of], left[of], slope[:, of], away, narrow)
        return replace(self, parameters=parameters)
