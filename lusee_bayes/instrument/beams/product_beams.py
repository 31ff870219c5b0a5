"""The beam B_k of every correlation product, and its spherical-harmonic coefficients."""

from __future__ import annotations

import equinox as eqx
import numpy as np
from jaxtyping import Complex, Float

from lusee_bayes.core.arrays import Array, namespace
from lusee_bayes.core.checks import Described, extent, listed, require_float64
from lusee_bayes.core.errors import InputError, nearest
from lusee_bayes.core.harmonics import lmax_of
from lusee_bayes.instrument.beams.fields import AntennaFields
from lusee_bayes.instrument.products import auto_indices, labels, to_real

STOKES = ("I", "Q", "U", "V")


def stokes_beam(
    fields: AntennaFields, stokes: str = "I"
) -> Complex[Array, "antennas antennas theta phi"]:
    """Return :func:`stokes_pairs` of the fields, on their grid."""
    return stokes_pairs(fields.e_theta, fields.e_phi, stokes)


def stokes_pairs(
    e_theta: Complex[Array, "antennas *directions"],
    e_phi: Complex[Array, "antennas *directions"],
    stokes: str = "I",
) -> Complex[Array, "antennas antennas *directions"]:
    """Return the response of <s_i conj(s_j)> to one Stokes parameter of the sky, for every pair.

    With E = E_i, F = E_j::

        I: (Et Ft* + Ep Fp*) / 2      Q: (Et Ft* - Ep Fp*) / 2
        U: (Et Fp* + Ep Ft*) / 2      V: i (Ep Ft* - Et Fp*) / 2

    from <e_a conj(e_b)> = [[I + Q, U - i V], [U + i V, I - Q]] / 2 in the basis (theta, phi), with
    exp(+i w t). V is the IAU's, right-handed minus left-handed: where it is positive, a receiver
    that looks towards the source sees the electric field turn counter-clockwise. The paper's U and
    V lack the factor 1/2; with it a fully polarised wave gives ``|E.e|^2``.

    Parameters
    ----------
    e_theta, e_phi : (antennas, ...) complex array
        Fields in any set of directions.
    stokes : {"I", "Q", "U", "V"}

    Returns
    -------
    (antennas, antennas, ...) complex array

    Raises
    ------
    InputError
        If the Stokes parameter is unknown.

    References
    ----------
    Hamaker and Bregman 1996, A&AS 117, 161 (the IAU's convention for V).
    """
    if stokes not in STOKES:
        raise InputError(f"unknown Stokes parameter '{stokes}'; {nearest(stokes, STOKES)}")
    et, ep = e_theta[:, None], e_phi[:, None]
    ft, fp = e_theta[None].conj(), e_phi[None].conj()
    if stokes == "I":
        return (et * ft + ep * fp) / 2.0
    if stokes == "Q":
        return (et * ft - ep * fp) / 2.0
    if stokes == "U":
        return (et * fp + ep * ft) / 2.0
    return 1j * (ep * ft - et * fp) / 2.0


class ProductBeams(Described, eqx.Module):
    """Harmonic coefficients of the beam of every product, in the topocentric frame.

    Beams are zero below the horizon.

    Attributes
    ----------
    modes : (products, modes) array
        Real packed; V_k = sum_c modes[k, c] a_c for a sky a_c in the topocentric frame. In K per K.
    frequency_mhz : float

    Raises
    ------
    InputError
        If the shape of ``modes`` fits no number of antennas or no lmax.
    """

    modes: Float[Array, "products modes"]
    frequency_mhz: float = eqx.field(static=True)

    def __check_init__(self):
        require_float64("the beam coefficients", self.modes)
        lmax_of(self.modes.shape[-1])
        n = round(np.sqrt(self.modes.shape[0]))
        if n * n != self.modes.shape[0]:
            raise InputError(
                f"{self.modes.shape[0]} products do not come from any number of antennas; "
                "expected 1, 4, 9, 16, ..."
            )

    def description(self) -> tuple[str, ...]:
        autos = self.modes[auto_indices(round(np.sqrt(self.n_products))), 0]
        return (
            f"{self.n_products} products at {self.frequency_mhz:g} MHz, lmax = {self.lmax}",
            f"{self.modes.shape[1]} real coefficients each, topocentric, K per K: "
            f"{listed(self.labels)}",
            f"integrals of the autos over the sky {extent(autos * np.sqrt(4.0 * np.pi), 'sr K/K')}",
        )

    @property
    def lmax(self) -> int:
        """Highest ell."""
        return lmax_of(self.modes.shape[-1])

    @property
    def n_products(self) -> int:
        """Number of real products."""
        return self.modes.shape[0]

    @property
    def labels(self) -> tuple[str, ...]:
        """Labels of the products, in order."""
        return labels(round(np.sqrt(self.n_products)))


def product_beams(
    fields: AntennaFields,
    frequency_mhz: float,
    lmax: int,
    *,
    stokes: str = "I",
    normalise: bool = True,
) -> ProductBeams:
    """Return the beams of all products of the antennas.

    Parameters
    ----------
    fields : AntennaFields
    frequency_mhz : float
    lmax : int
    stokes : {"I", "Q", "U", "V"}
    normalise : bool
        Scale the beams so that the Stokes I autos integrate to one on average, which makes
        visibilities antenna temperatures in K. Otherwise the scale of the fields is kept.

    Returns
    -------
    ProductBeams

    Raises
    ------
    InputError
        If the Stokes parameter is unknown or the grid is too coarse for ``lmax``.
    """
    modes = product_modes(fields, lmax, stokes=stokes, normalise=normalise)
    return ProductBeams(modes, float(frequency_mhz))


def product_modes(
    fields: AntennaFields, lmax: int, *, stokes: str = "I", normalise: bool = True
) -> Float[Array, "products modes"]:
    """Return the coefficients of :func:`product_beams`, a (products, modes) array."""
    patterns = to_real(stokes_beam(fields, stokes))
    if normalise:
        patterns = patterns / mean_auto_integral(fields)
    return fields.grid.modes(patterns, lmax)


def mean_auto_integral(fields: AntennaFields) -> Float[Array, ""]:
    """Return the integral of the Stokes I auto beam in steradian, averaged over antennas."""
    autos = to_real(stokes_beam(fields))[auto_indices(fields.n_antennas)]
    integrals = fields.grid.integrate(autos)
    return namespace(integrals).asarray(integrals.mean())
