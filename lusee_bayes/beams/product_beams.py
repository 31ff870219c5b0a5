"""The beam B_k of every correlation product, and its spherical-harmonic coefficients."""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from lusee_bayes.beams.fields import AntennaFields
from lusee_bayes.checks import InputError, nearest, require_float64
from lusee_bayes.harmonics import lmax_of
from lusee_bayes.products import auto_indices, labels, to_real

STOKES = ("I", "Q", "U", "V")


def stokes_beam(
    fields: AntennaFields, stokes: str = "I"
) -> Complex[Array, "antennas antennas theta phi"]:
    """Response of <s_i conj(s_j)> to one Stokes parameter of the sky, for every pair.

    :func:`stokes_pairs` of the fields, on their grid.
    """
    return stokes_pairs(fields.e_theta, fields.e_phi, stokes)


def stokes_pairs(
    e_theta: Complex[Array, "antennas *directions"],
    e_phi: Complex[Array, "antennas *directions"],
    stokes: str = "I",
) -> Complex[Array, "antennas antennas *directions"]:
    """Response of <s_i conj(s_j)> to one Stokes parameter, in any set of directions.

    With E = E_i, F = E_j:

        I: (Et Ft* + Ep Fp*) / 2      Q: (Et Ft* - Ep Fp*) / 2
        U: (Et Fp* + Ep Ft*) / 2      V: i (Et Fp* - Ep Ft*) / 2

    from <e_a conj(e_b)> = [[I + Q, U + i V], [U - i V, I - Q]] / 2. The paper's U and V lack the
    factor 1/2; with it a fully polarised wave gives |E.e|^2 (tests/test_beams.py).
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
    return 1j * (et * fp - ep * ft) / 2.0


class ProductBeams(eqx.Module):
    """Harmonic coefficients of the beam of every product, in the topocentric frame.

    modes : (products, modes) real packed; V_k = sum_c modes[k, c] a_c for a sky a_c in K given in
    the topocentric frame. Zero below the horizon. frequency_mhz : for the record and the sky.
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

    @property
    def lmax(self) -> int:
        """Highest ell of the coefficients."""
        return lmax_of(self.modes.shape[-1])

    @property
    def n_products(self) -> int:
        """Number of real products."""
        return self.modes.shape[0]

    @property
    def labels(self) -> tuple[str, ...]:
        """Product labels in order."""
        return labels(round(np.sqrt(self.n_products)))


def product_beams(
    fields: AntennaFields,
    frequency_mhz: float,
    lmax: int,
    *,
    stokes: str = "I",
    normalise: bool = True,
) -> ProductBeams:
    """Beams of all products of the antennas, up to ``lmax``.

    ``normalise``: scale so that the Stokes I autos integrate, on average, to one, which makes
    visibilities antenna temperatures in K. Without it the fields' own scale is kept.
    """
    modes = product_modes(fields, lmax, stokes=stokes, normalise=normalise)
    return ProductBeams(modes, float(frequency_mhz))


def product_modes(
    fields: AntennaFields, lmax: int, *, stokes: str = "I", normalise: bool = True
) -> Float[Array, "products modes"]:
    """The coefficients of :func:`product_beams`."""
    patterns = to_real(stokes_beam(fields, stokes))
    if normalise:
        patterns = patterns / mean_auto_integral(fields)
    return fields.grid.modes(patterns, lmax)


def mean_auto_integral(fields: AntennaFields) -> Float[Array, ""]:
    """Average over antennas of the integral of the Stokes I auto beam, in steradian."""
    autos = to_real(stokes_beam(fields))[auto_indices(fields.n_antennas)]
    return jnp.mean(fields.grid.integrate(autos))
