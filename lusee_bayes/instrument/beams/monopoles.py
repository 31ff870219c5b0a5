"""The package's own antenna model: thin monopoles above layered ground.

An arm of length L points outwards and up from the feed, at height h over the ground; its current
is I(s) ~ sin k(L - s). A wave from direction n reaches it directly and off the ground, so its
response to the theta and phi components is

    E = int I(s) [ u.e exp(i k n.r) + u.e' exp(i k n'.r - 2 i k h n_z) ] ds,   r = s u,

with u the arm, n' = n mirrored in the ground and e' the reflected polarisation. No coupling
between arms, no lander: this is good enough for the paper's findings, and differentiable in all
parameters.
"""

from __future__ import annotations

import equinox as eqx
import numpy as np
from jaxtyping import Complex, Float

from lusee_bayes.core.arrays import Array, as_complex, compiled, namespace
from lusee_bayes.core.checks import require_finite, require_positive
from lusee_bayes.instrument.beams.fields import AntennaFields, phasor, wavenumber
from lusee_bayes.instrument.beams.grid import HemisphereGrid
from lusee_bayes.instrument.beams.product_beams import ProductBeams, product_modes
from lusee_bayes.instrument.beams.regolith import Regolith

# ports 0, 1, 2, 3 point North, East, South, West; phi counts from East towards North
PORT_AZIMUTHS_DEG = (90.0, 0.0, -90.0, 180.0)


def _array(x) -> Float[Array, "..."]:
    return namespace(x).asarray(x, dtype=np.float64)


class Monopoles(eqx.Module):
    """Identical arms with a common feed, at several azimuths; differentiable in all parameters.

    Attributes
    ----------
    regolith : Regolith
        The ground.
    length_m : float
        Length of an arm.
    zenith_angle_deg : float
        Angle of the arms from the zenith; above 90 they droop.
    height_m : float
        Height of the feed over the ground.
    azimuths_deg : (antennas,) array
        Directions of the arms at turntable angle zero, from East towards North.
    turntable_offset_deg : float
        How much further the turntable is than it says, from East towards North.

    Raises
    ------
    InputError
        If a length is not positive or an angle is not finite.
    """

    regolith: Regolith = eqx.field(default_factory=Regolith)
    length_m: Float[Array, ""] = eqx.field(default=3.0, converter=_array)
    zenith_angle_deg: Float[Array, ""] = eqx.field(default=75.0, converter=_array)
    height_m: Float[Array, ""] = eqx.field(default=2.0, converter=_array)
    azimuths_deg: Float[Array, " antennas"] = eqx.field(default=PORT_AZIMUTHS_DEG, converter=_array)
    turntable_offset_deg: Float[Array, ""] = eqx.field(default=0.0, converter=_array)

    def __check_init__(self):
        require_finite("zenith_angle_deg", self.zenith_angle_deg)
        require_finite("azimuths_deg", self.azimuths_deg)
        require_finite("turntable_offset_deg", self.turntable_offset_deg)
        require_positive("length_m", self.length_m)
        require_positive("height_m", self.height_m)

    def fields(
        self, frequency_mhz: float | Float[Array, ""], grid: HemisphereGrid
    ) -> AntennaFields:
        """Return the field patterns on a grid, with the phase centre at the feed for all arms."""
        require_positive("frequency_mhz", frequency_mhz)
        e_theta, e_phi = self.towards(frequency_mhz, grid.theta[:, None], grid.phi[None])
        return AntennaFields(e_theta, e_phi, grid)

    def towards(
        self,
        frequency_mhz: float | Float[Array, ""],
        theta: Float[Array, "*#directions"],
        phi: Float[Array, "*#directions"],
    ) -> tuple[Complex[Array, "antennas *directions"], Complex[Array, "antennas *directions"]]:
        """Return the fields of every arm in directions above the horizon; phase centre: the feed.

        Parameters
        ----------
        frequency_mhz : float
        theta, phi : array
            In radians, with the same number of axes; they broadcast against each other. The
            reflection off the ground is computed once for every entry of theta.

        Returns
        -------
        e_theta, e_phi : (antennas, ...) complex array
        """
        # an array, so that all frequencies share one program
        return self._towards(_array(frequency_mhz), theta, phi)

    @compiled
    def _towards(
        self,
        frequency_mhz: Float[Array, ""],
        theta: Float[Array, "*#directions"],
        phi: Float[Array, "*#directions"],
    ) -> tuple[Complex[Array, "antennas *directions"], Complex[Array, "antennas *directions"]]:
        k = wavenumber(frequency_mhz)
        xp = namespace(self, frequency_mhz, theta, phi)
        cos, sin = xp.cos(theta)[None], xp.sin(theta)[None]
        tilt = xp.radians(self.zenith_angle_deg)
        azimuth = xp.radians(self.azimuths_deg + self.turntable_offset_deg).reshape(
            -1, *(1,) * phi.ndim
        )
        relative = phi[None] - azimuth
        # the arm along the horizontal direction of the wave, across it, and up
        along, across, up = (
            xp.sin(tilt) * xp.cos(relative),
            -xp.sin(tilt) * xp.sin(relative),
            xp.cos(tilt),
        )
        s, p = (
            r.reshape(cos.shape) for r in self.regolith.reflection(cos.reshape(-1), frequency_mhz)
        )
        ground = phasor(-2.0 * k * self.height_m * cos)
        direct = self._current_integral(k, along * sin + up * cos)
        bounced = self._current_integral(k, along * sin - up * cos) * ground
        to_direct = (along * cos - up * sin).astype(direct.dtype)
        to_bounced = (along * cos + up * sin).astype(direct.dtype)
        e_theta = to_direct * direct - p * to_bounced * bounced
        e_phi = across.astype(direct.dtype) * (direct + s * bounced)
        return e_theta, e_phi

    def _current_integral(
        self, k: float | Float[Array, ""], projection: Float[Array, "antennas *directions"]
    ) -> Complex[Array, "antennas *directions"]:
        """int_0^L sin k(L - s) exp(i k s projection) ds.

        = (L / 2i) [exp(i b) sinc a - exp(-i a) sinc b],  a, b = k L (1 -+ projection) / 2:
        the sine as two exponentials, whose integrals are sincs; nothing is singular.
        """
        kl = k * self.length_m
        a, b = kl * (1.0 - projection) / 2.0, kl * (1.0 + projection) / 2.0
        xp = namespace(a)
        sinc_a, sinc_b = xp.sinc(a / np.pi), xp.sinc(b / np.pi)
        real = xp.sin(b) * sinc_a + xp.sin(a) * sinc_b
        imaginary = xp.cos(a) * sinc_b - xp.cos(b) * sinc_a
        half = self.length_m / 2.0
        return as_complex(real * half, imaginary * half)


def monopole_beams(
    frequency_mhz: float,
    lmax: int,
    monopoles: Monopoles | None = None,
    *,
    stokes: str = "I",
    nodes: tuple[int, int] | None = None,
) -> ProductBeams:
    """Return the beams of the embedded antennas; their autos integrate to one on average.

    Differentiable in every parameter of ``monopoles``. Compiled once for all frequencies.

    Parameters
    ----------
    frequency_mhz : float
    lmax : int
    monopoles : Monopoles, optional
        By default the paper's four arms on its ground.
    stokes : {"I", "Q", "U", "V"}
    nodes : tuple of int, optional
        Number of nodes in theta and in phi, by default enough to be exact to rounding; fewer are
        faster.

    Returns
    -------
    ProductBeams

    Raises
    ------
    InputError
        If the frequency is not positive or the Stokes parameter is unknown.
    """
    monopoles = Monopoles() if monopoles is None else monopoles
    require_positive("frequency_mhz", frequency_mhz)
    modes = _modes(_array(frequency_mhz), lmax, monopoles, stokes, nodes)
    return ProductBeams(modes, float(frequency_mhz))


@compiled
def _modes(
    frequency_mhz: Float[Array, ""],
    lmax: int,
    monopoles: Monopoles,
    stokes: str,
    nodes: tuple[int, int] | None,
) -> Float[Array, "products modes"]:
    exact = HemisphereGrid.for_lmax
    grid = exact(lmax) if nodes is None else HemisphereGrid.gauss_legendre(*nodes)
    return product_modes(monopoles.fields(frequency_mhz, grid), lmax, stokes=stokes)
