"""A positive sky: a template times the exponential of a Gaussian field, and point sources.

::

    m = P[T exp(Y a)] + sum_j F_j g(eta_j) y(n_j),    a ~ N(0, C_ell),    eta_j ~ N(0, 1)

T is a template, Y synthesis on a grid, P integration with the harmonics of the map, F_j the
catalogued flux of a source in the direction n_j, and g(eta) = -ln Phi(-eta), so that its flux has
an exponential distribution of mean F_j: it is positive and may be absent. The unknowns are white:
u = (xi, eta) ~ N(0, 1) with a = C^(1/2) xi.
"""

from __future__ import annotations

from dataclasses import replace

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float
from scipy.special import log_ndtr

from lusee_bayes.core.arrays import Array, namespace
from lusee_bayes.core.checks import is_traced, require_finite, require_positive
from lusee_bayes.core.errors import InputError
from lusee_bayes.core.harmonics import mode_numbers, n_modes, per_mode
from lusee_bayes.core.sphere_grid import SphereGrid
from lusee_bayes.sky.galaxy import PointSource
from lusee_bayes.sky.template import Template

# band limit of the grid: this many times that of the map, and at least so much, since what the
# grid does not resolve of the template folds back into the map
GRID, LEAST_GRID = 3, 96


def deviation_spectrum(
    lmax: int,
    amplitude: float | Float[Array, ""],
    tilt: float | Float[Array, ""],
    level: Float[Array, "1"],
) -> Float[Array, " ells"]:
    """Compute C_ell = A^2 ((ell + 1) / 10)^tilt of the logarithm of a sky over its template.

    Parameters
    ----------
    lmax : int
    amplitude, tilt : float or () array
        A and the slope.
    level : (1,) array
        C_0: 4 pi times the variance of the logarithm of the template's scale.

    Returns
    -------
    (ells,) array
        Without unit.
    """
    xp = namespace(amplitude, tilt, level)
    ell = np.arange(1.0, lmax + 1.0)
    return xp.concatenate([level, amplitude**2 * ((ell + 1.0) / 10.0) ** tilt])


class LogNormalSky(eqx.Module):
    """The sky as a function of white unknowns; see the module's equations.

    Attributes
    ----------
    spectrum : (ells,) array
        C_ell of the logarithm, without unit; of the map's lmax, which is what the data can tell
        apart: twice that changes ln evidence by 0.4 and standard deviations by 0.4 %.
    grid : SphereGrid
        Where products are taken.
    level : (rings, phi) array
        T on the grid, in K.
    source_modes : (sources, modes) array
        F_j y(n_j), in K.
    """

    spectrum: Float[Array, " ells"]
    grid: SphereGrid
    level: Float[Array, "rings phi"]
    source_modes: Float[Array, "sources modes"]

    @classmethod
    def of(
        cls,
        template: Template,
        spectrum: Float[np.ndarray, " ells"],
        frequency_mhz: float,
        sources: tuple[PointSource, ...] = (),
        *,
        band: int | None = None,
    ) -> LogNormalSky:
        """Make it, in NumPy.

        Parameters
        ----------
        template : Template
            T.
        spectrum : (ells,) array
            C_ell of the logarithm; its lmax is the map's.
        frequency_mhz : float
            Of template and sources.
        sources : tuple of PointSource
        band : int, optional
            Band limit of the grid; by default three times lmax, and at least 96.

        Raises
        ------
        InputError
            If the template is not positive everywhere, or the spectrum not at every ell.
        """
        lmax = len(spectrum) - 1
        _require_power(spectrum)
        grid = SphereGrid.of(lmax, max(GRID * lmax, LEAST_GRID) if band is None else band)
        level = template.at(*grid.directions()).reshape(grid.shape)
        require_positive("the template", level, "a log-normal sky is a positive template times exp")
        modes = [source.modes(frequency_mhz, lmax) for source in sources]
        return cls(
            np.asarray(spectrum), grid, level, np.reshape(modes, (len(sources), n_modes(lmax)))
        )

    @property
    def lmax(self) -> int:
        """Highest ell of the map."""
        return self.grid.lmax

    @property
    def n_modes(self) -> int:
        """Number of modes of the map, and of xi."""
        return n_modes(self.lmax)

    @property
    def size(self) -> int:
        """Number of white unknowns: modes of the logarithm, then sources."""
        return self.n_modes + len(self.source_modes)

    def with_power_law(
        self, amplitude: float | Float[Array, ""], tilt: float | Float[Array, ""]
    ) -> LogNormalSky:
        """Return the same with C_ell = A^2 ((ell + 1) / 10)^tilt for ell > 0.

        Parameters
        ----------
        amplitude, tilt : float or () array
            A and the slope.
        """
        level = self.spectrum[:1]
        return replace(self, spectrum=deviation_spectrum(self.lmax, amplitude, tilt, level))

    def power_law_slopes(self) -> Float[np.ndarray, "2 modes"]:
        """Return the derivatives of ln C_ell^(1/2) by ln A and by the tilt, for every mode."""
        ell, _ = mode_numbers(self.lmax)
        slopes = np.stack([np.ones(len(ell)), 0.5 * np.log((ell + 1.0) / 10.0)])
        return np.where(ell > 0, slopes, 0.0)

    def root(self) -> Float[Array, " unknowns"]:
        """Return C^(1/2) of every mode of the logarithm, and 1 for every source."""
        xp = namespace(self.spectrum)
        return xp.concatenate([xp.sqrt(per_mode(self.spectrum)), np.ones(len(self.source_modes))])

    def logarithm(self, white: Float[Array, "*batch unknowns"]) -> Float[Array, "*batch modes"]:
        """Compute a, the modes of ln(sky / T) without sources."""
        root = self.root()[: self.n_modes]
        return white[..., : self.n_modes] * root.reshape(*(1,) * (white.ndim - 1), -1)

    def diffuse(self, white: Float[Array, "*batch unknowns"]) -> Float[Array, "*batch rings phi"]:
        """Compute T exp(Y a) on the grid, in K."""
        xp = namespace(self, white)
        field = xp.exp(self.grid.synthesise(self.logarithm(white)))
        return field * self.level.reshape(*(1,) * (white.ndim - 1), *self.level.shape)

    def source_factors(
        self, white: Float[Array, "*batch unknowns"]
    ) -> Float[Array, "*batch sources"]:
        """Compute g(eta): fluxes of the sources over the catalogued ones."""
        eta = white[..., self.n_modes :]
        if namespace(white) is np:
            return -log_ndtr(-eta)
        return -jax.scipy.special.log_ndtr(-eta)

    def modes(self, white: Float[Array, "*batch unknowns"]) -> Float[Array, "*batch modes"]:
        """Compute m.

        Parameters
        ----------
        white : (..., unknowns) array
            u.

        Returns
        -------
        (..., modes) array
            Real packed coefficients, Galactic, in K.
        """
        diffuse = self.grid.analyse(self.diffuse(white))
        return diffuse + self.source_factors(white) @ self.source_modes

    def jacobian(self, white: Float[np.ndarray, " unknowns"]) -> Float[np.ndarray, "modes _"]:
        """Compute dm/du as a matrix, in NumPy.

        Parameters
        ----------
        white : (unknowns,) array
            u.

        Returns
        -------
        (modes, unknowns) array
            In K.
        """
        white, root = np.asarray(white), np.asarray(self.root())
        matrix = np.empty((self.n_modes, self.size))
        product = self.grid.product_matrix(np.asarray(self.diffuse(white)))
        np.multiply(product, root[None, : self.n_modes], out=matrix[:, : self.n_modes])
        eta = white[self.n_modes :]
        # g' = phi(eta) / Phi(-eta)
        slope = np.exp(-0.5 * eta**2 - log_ndtr(-eta)) / np.sqrt(2.0 * np.pi)
        matrix[:, self.n_modes :] = np.asarray(self.source_modes).T * slope
        return matrix


def _require_power(spectrum: Float[Array, " ells"]) -> None:
    require_finite("the spectrum of the logarithm", spectrum)
    if is_traced(spectrum):
        return
    without = np.flatnonzero(~(np.asarray(spectrum) > 0))
    if without.size:
        raise InputError(
            f"the spectrum of the logarithm has no power at ell = {without[0]}: C_ell = "
            f"{float(spectrum[without[0]]):.3g}; give it a positive value at every ell"
        )
