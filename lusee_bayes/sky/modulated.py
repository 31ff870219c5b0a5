"""A Gaussian sky that departs from a template in proportion to a scale.

::

    m = s M + c y_00 + P[D Y a] + sum_j f_j F_j y(n_j),    a ~ N(0, C_ell),

M are the modes of a template T, and D is a scale that varies over the sky, by default T itself. Y
is synthesis on a grid, P integration with the harmonics of the map. The overall scale s of T, the
monopole c and the fluxes f_j F_j of point sources are unknown, too. So m is Gaussian, with ::

    mean = M + sum_j F_j y(n_j),    S = B C B^T + sum_k t_k t_k^T,    B_ij = int y_i D y_j dOmega,

where t_k are the patterns of s, c and f_j times their standard deviations. B is summed over the
rings of a Gauss-Legendre rule, order by order; nothing is formed on pixels.
"""

from __future__ import annotations

import equinox as eqx
import numpy as np
from jaxtyping import Float

from lusee_bayes.core.arrays import Array, namespace
from lusee_bayes.core.checks import (
    is_traced,
    require_finite,
    require_float64,
    require_positive,
    require_shape,
)
from lusee_bayes.core.errors import InputError
from lusee_bayes.core.harmonics import lmax_of, n_modes, per_mode
from lusee_bayes.core.linalg import gram_matrix
from lusee_bayes.core.representation import Described
from lusee_bayes.core.sphere_grid import SphereGrid
from lusee_bayes.sky.priors import DensePrior
from lusee_bayes.sky.template import LEAST_BAND, Template

# highest ell of the deviations, over that of the map; see docs/validation.md
DEVIATIONS = 1.5


def relative_spectrum(
    lmax: int, amplitude: float | Float[Array, ""], tilt: float | Float[Array, ""]
) -> Float[Array, " ells"]:
    """Compute C_ell = A^2 ((ell + 1) / 10)^tilt of relative deviations.

    Parameters
    ----------
    lmax : int
    amplitude, tilt : float or () array
        A and the slope.

    Returns
    -------
    (ells,) array
        For ell = 0..lmax, without unit.
    """
    return amplitude**2 * ((np.arange(lmax + 1.0) + 1.0) / 10.0) ** tilt


class Modulation(Described, eqx.Module):
    """All of a modulated prior but C_ell: :meth:`prior` makes one of each C_ell.

    Attributes
    ----------
    mean : (modes,) array
        Of m, in K.
    matrix : (modes, deviations) array
        B, in K.
    patterns : (patterns, modes) array
        t_k, in K.
    """

    mean: Float[np.ndarray, " modes"]
    matrix: Float[np.ndarray, "modes deviations"]
    patterns: Float[np.ndarray, "patterns modes"]

    @classmethod
    def of(
        cls,
        template: Template,
        lmax: int,
        *,
        scale: Template | None = None,
        sources: Float[np.ndarray, "sources modes"] | None = None,
        sources_in_template: bool = False,
        scale_std: float = 0.5,
        monopole_std: float = 1.0,
        lmax_deviations: int | None = None,
    ) -> Modulation:
        """Make it of a template.

        Parameters
        ----------
        template : Template
            T.
        lmax : int
            Of the map.
        scale : Template, optional
            D; by default T.
        sources : (sources, modes) array, optional
            F_j y(n_j) of point sources, in K.
        sources_in_template : bool
            Whether M holds them already; else they are added to the mean.
        scale_std : float
            Standard deviation of s, about 1.
        monopole_std : float
            Standard deviation of c, over the template's own monopole.
        lmax_deviations : int, optional
            Highest ell of a, at least ``lmax``; by default 1.5 ``lmax``.

        Raises
        ------
        InputError
            If D is not positive everywhere, or ``lmax_deviations`` is below ``lmax``.
        """
        highest = round(DEVIATIONS * lmax) if lmax_deviations is None else lmax_deviations
        if highest < lmax:
            raise InputError(
                f"the deviations' lmax is {highest}, that of the map {lmax}; give them as many "
                "modes at least"
            )
        grid = SphereGrid.of(highest, max(lmax + highest, LEAST_BAND))
        width = (scale or template).at(*grid.directions()).reshape(grid.shape)
        _require_scale(width, "the template" if scale is None else "the scale of the deviations")
        modes = template.modes(lmax)
        monopole = np.zeros(n_modes(lmax))
        monopole[0] = monopole_std * modes[0]
        beside = np.zeros((0, len(modes))) if sources is None else sources
        return cls(
            modes if sources_in_template else modes + beside.sum(0),
            grid.product_matrix(width, lmax),
            np.concatenate([[scale_std * modes, monopole], beside]),
        )

    def description(self) -> tuple[str, ...]:
        n, more = self.matrix.shape
        return (
            f"deviations from a template, in proportion to a scale: lmax = {lmax_of(n)}, of the "
            f"deviations {lmax_of(more)}",
            f"{len(self.patterns)} patterns of unknown strength: scale, monopole, sources",
            "prior(C_ell)",
        )

    @property
    def lmax_deviations(self) -> int:
        """Highest ell of a."""
        return lmax_of(self.matrix.shape[1])

    def prior(self, spectrum: Float[Array, " ells"]) -> DensePrior:
        """Make the prior of a C_ell.

        Parameters
        ----------
        spectrum : (ells,) array
            C_ell of a, for ell = 0..``lmax_deviations``; without unit, if D is in K.

        Raises
        ------
        InputError
            If C_ell has another length or is not positive at every ell, or S is not positive
            definite.
        """
        require_float64("the spectrum of the deviations", spectrum)
        require_shape("the spectrum of the deviations", spectrum, (self.lmax_deviations + 1,))
        _require_power(spectrum)
        xp = namespace(spectrum)
        coloured = self.matrix * xp.sqrt(per_mode(spectrum))[None]
        covariance = gram_matrix(coloured.T) + gram_matrix(xp.asarray(self.patterns))
        return DensePrior.of_covariance(covariance, xp.asarray(self.mean))


def modulated_prior(
    template: Template, spectrum: Float[Array, " ells"], lmax: int, **options
) -> DensePrior:
    """Make a prior of a template and C_ell at once; to change C_ell, keep the :class:`Modulation`.

    Parameters
    ----------
    template : Template
        T.
    spectrum : (ells,) array
        C_ell of a; its lmax is that of the deviations.
    lmax : int
        Of the map.
    **options
        As in :meth:`Modulation.of`.

    Raises
    ------
    InputError
        As :meth:`Modulation.of` and :meth:`Modulation.prior`.
    """
    modulation = Modulation.of(template, lmax, lmax_deviations=len(spectrum) - 1, **options)
    return modulation.prior(spectrum)


def _require_scale(width: Float[np.ndarray, "rings phi"], name: str) -> None:
    if not width.any():
        raise InputError(f"{name} is zero everywhere: nothing could deviate from the mean sky")
    require_positive(name, width, "smooth it (smoothing_deg), or give another one")


def _require_power(spectrum: Float[Array, " ells"]) -> None:
    require_finite("the spectrum of the deviations", spectrum)
    if is_traced(spectrum):
        return
    without = np.flatnonzero(~(np.asarray(spectrum) > 0))
    if without.size:
        ell = int(without[0])
        raise InputError(
            f"the spectrum of the deviations has no power at ell = {ell}: C_ell = "
            f"{float(spectrum[ell]):.3g}; give it a positive value at every ell"
        )
