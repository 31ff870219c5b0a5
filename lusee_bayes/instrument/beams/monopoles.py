"""Monopoles on a lossy ground: fields, beams and their parameters.

This is the package's own antenna model: thin monopoles above layered ground. An arm of length L
points outwards and up from the feed, at height h over the ground; its current is I(s) ~ sin k(L -
s). A wave from direction n reaches it directly and off the ground, so its response to the theta and
phi components is

    E = int I(s) [ u.e exp(i k n.r) + u.e' exp(i k n'.r - 2 i k h n_z) ] ds,   r = s u,

with u the arm, n' = n mirrored in the ground and e' the reflected polarisation. No coupling between
arms, no lander: this suffices for the paper's findings, and is differentiable in all parameters.

**Point sources** are blurred by harmonic coefficients up to lmax, but not by the field pattern
itself (:func:`beams_towards`). A source of x K sr in the direction n(t), in the frame of the
antennas, gives V_k(t) = x B_k(n(t)) (:func:`source_response`). It rises and sets sharply, and may
move.
"""

from collections.abc import Callable, Mapping
from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import Complex, Float
from scipy.constants import speed_of_light

from lusee_bayes.core.arrays import Array, as_complex, compiled, namespace
from lusee_bayes.core.checks import is_traced, require_array, require_finite, require_positive
from lusee_bayes.core.errors import InputError
from lusee_bayes.instrument.beams import fields as beam_fields
from lusee_bayes.instrument.beams.fields import AntennaFields, Fields, HemisphereGrid, ProductBeams
from lusee_bayes.instrument.beams.source import BeamSource, Parameter
from lusee_bayes.instrument.observation import Observation
from lusee_bayes.instrument.products import to_real

N_LAYERS = 8
DEPTH_M = 100.0


Scalar = float | Float[Array, ""]
Vectors = Float[Array, "directions 3"]
Angles = Float[Array, "*#directions"]
Patterns = Float[Array, "products directions"]
Coefficients = Complex[Array, " theta"]


def wavenumber(frequency_mhz: Scalar) -> Scalar:
    """Return k = 2 pi / wavelength, in 1/m."""
    return 2.0e6 * np.pi * frequency_mhz / speed_of_light


def _array(x) -> Float[Array, "..."]:
    return namespace(x).asarray(x, dtype=np.float64)


class Regolith(eqx.Module):
    """Eight homogeneous layers, the last one infinitely deep; differentiable in all parameters.

    The real permittivity rises linearly over 100 m. Time convention exp(+i w t), so that
    eps = eps' (1 - i tan delta).

    Attributes
    ----------
    surface_permittivity, deep_permittivity : float
        Real relative permittivity of the top and of the bottom layer; 3.7 and 6.1 in the paper.
    loss_tangent : float
        The same in all layers; 0.01 in the paper.

    Raises
    ------
    InputError
        If a permittivity is not positive or the loss tangent is negative.

    References
    ----------
    Grimm 2018, fits to the surface electrical properties experiment of Apollo 17.
    """

    surface_permittivity: Float[Array, ""] = eqx.field(default=3.7, converter=_array)
    deep_permittivity: Float[Array, ""] = eqx.field(default=6.1, converter=_array)
    loss_tangent: Float[Array, ""] = eqx.field(default=0.01, converter=_array)

    def __check_init__(self):
        require_positive("surface_permittivity", self.surface_permittivity)
        require_positive("deep_permittivity", self.deep_permittivity)
        if not is_traced(self.loss_tangent) and not self.loss_tangent >= 0:
            raise InputError(f"loss_tangent must not be negative, got {self.loss_tangent}")

    def permittivities(self) -> Complex[Array, " layers"]:
        """Return the complex relative permittivity of each layer from the top down."""
        rise = np.linspace(0.0, 1.0, N_LAYERS)
        top, bottom = self.surface_permittivity, self.deep_permittivity
        real = top + rise * (bottom - top)
        return as_complex(real, -real * self.loss_tangent)

    def reflection(
        self, cos_theta: Float[Array, " theta"], frequency_mhz: Scalar
    ) -> tuple[Coefficients, Coefficients]:
        """Return the reflection coefficients for waves that arrive at zenith angle theta.

        By recursion over the interfaces from the bottom up, with Fresnel coefficients at each.

        Parameters
        ----------
        cos_theta : (theta,) array
        frequency_mhz : float

        Returns
        -------
        s : (theta,) complex array
            Coefficient of the horizontal electric field (phi component); -1 for a conductor.
        p : (theta,) complex array
            Coefficient of the magnetic field: the reflected theta component is -p cos theta along
            the horizontal and -p sin theta along the vertical; +1 for a conductor.

        References
        ----------
        Born & Wolf, Principles of Optics, section 1.6.4.
        """
        thickness = wavenumber(frequency_mhz) * DEPTH_M / (N_LAYERS - 1)  # in radians of vacuum
        xp = namespace(self, cos_theta, frequency_mhz)
        thickness = xp.asarray(thickness, dtype=np.complex128)
        cosine = xp.asarray(cos_theta, dtype=np.complex128)
        sin2 = 1.0 - cosine**2
        eps = [xp.ones((), dtype=np.complex128), *self.permittivities()]
        # vertical wave numbers over k; the root with Im <= 0 decays downwards under exp(+i w t)
        roots = [xp.sqrt(e - sin2) for e in eps[1:]]
        vertical = [cosine] + [xp.where(root.imag > 0, -root, root) for root in roots]
        s, p = xp.zeros_like(vertical[0]), xp.zeros_like(vertical[0])
        # nothing comes back from below the last interface: s = p = 0
        for upper in range(N_LAYERS - 1, -1, -1):
            q0, q1 = vertical[upper], vertical[upper + 1]
            y0, y1 = q0 * eps[upper + 1], q1 * eps[upper]
            fresnel_s, fresnel_p = (q0 - q1) / (q0 + q1), (y0 - y1) / (y0 + y1)
            delay = xp.exp(-2j * thickness * q1)
            s = (fresnel_s + s * delay) / (1.0 + fresnel_s * s * delay)
            p = (fresnel_p + p * delay) / (1.0 + fresnel_p * p * delay)
        return s, p


# ports 0, 1, 2, 3 point North, East, South, West; phi counts from East towards North
PORT_AZIMUTHS_DEG = (90.0, 0.0, -90.0, 180.0)


class Monopoles(BeamSource, eqx.Module):
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
        True minus stated turntable angle, from East towards North.
    nodes : (int, int) or None
        Nodes of the grid on which beams are computed; see :func:`monopole_beams`.

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
    nodes: tuple[int, int] | None = eqx.field(static=True, default=None)

    def __check_init__(self):
        for name in ("zenith_angle_deg", "azimuths_deg", "turntable_offset_deg"):
            require_finite(name, getattr(self, name))
        require_positive("length_m", self.length_m)
        require_positive("height_m", self.height_m)

    @property
    def n_ports(self) -> int:
        return self.azimuths_deg.size

    def parameters(self) -> dict[str, Parameter]:
        return {n: Parameter(where(self), *ends) for n, (where, *ends) in PARAMETERS.items()}

    def with_values(self, values: Mapping[str, float | Float[Array, ""]]) -> "Monopoles":
        changed = self
        for name, value in values.items():
            self.parameter(name)
            changed = eqx.tree_at(PARAMETERS[name][0], changed, _array(value))
        return changed

    def beams(self, frequency_mhz: float, lmax: int) -> ProductBeams:
        return monopole_beams(frequency_mhz, lmax, self, nodes=self.nodes)

    def response(self, frequency_mhz, directions, stokes="I"):
        return beams_towards(frequency_mhz, directions, self, stokes=stokes)

    def fields(self, frequency_mhz: Scalar, grid: HemisphereGrid) -> AntennaFields:
        """Return the field patterns on a grid, with the phase centre at the feed for all arms."""
        require_positive("frequency_mhz", frequency_mhz)
        # an array, so that all frequencies share one program
        frequency = _array(frequency_mhz)
        return AntennaFields(*self.towards(frequency, grid.theta[:, None], grid.phi[None]), grid)

    @compiled
    def towards(self, frequency_mhz: Scalar, theta: Angles, phi: Angles) -> tuple[Fields, Fields]:
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
        k = wavenumber(frequency_mhz)
        xp = namespace(self, frequency_mhz, theta, phi)
        cos, sin = xp.cos(theta)[None], xp.sin(theta)[None]
        tilt = xp.radians(self.zenith_angle_deg)
        azimuth = xp.radians(self.azimuths_deg + self.turntable_offset_deg)
        relative = phi[None] - azimuth.reshape(-1, *(1,) * phi.ndim)
        # the arm along the horizontal direction of the wave, across it, and up
        along, across = xp.sin(tilt) * xp.cos(relative), -xp.sin(tilt) * xp.sin(relative)
        up = xp.cos(tilt)
        reflected = self.regolith.reflection(cos.reshape(-1), frequency_mhz)
        s, p = (r.reshape(cos.shape) for r in reflected)
        angle = -2.0 * k * self.height_m * cos
        ground = as_complex(xp.cos(angle), xp.sin(angle))
        direct = self._current_integral(k, along * sin + up * cos)
        bounced = self._current_integral(k, along * sin - up * cos) * ground
        to_direct = (along * cos - up * sin).astype(direct.dtype)
        e_theta = to_direct * direct - p * (along * cos + up * sin).astype(direct.dtype) * bounced
        return e_theta, across.astype(direct.dtype) * (direct + s * bounced)

    def _current_integral(self, k: Scalar, projection: Array) -> Fields:
        """int_0^L sin k(L - s) exp(i k s projection) ds.

        = (L / 2i) [exp(i b) sinc a - exp(-i a) sinc b],  a, b = k L (1 -+ projection) / 2:
        the sine as two exponentials, whose integrals are sincs; nothing is singular.
        """
        kl = k * self.length_m
        a, b = kl * (1.0 - projection) / 2.0, kl * (1.0 + projection) / 2.0
        xp = namespace(a)
        sinc_a, sinc_b = xp.sinc(a / np.pi), xp.sinc(b / np.pi)
        real = xp.sin(b) * sinc_a + xp.sin(a) * sinc_b
        imaginary, half = xp.cos(a) * sinc_b - xp.cos(b) * sinc_a, self.length_m / 2.0
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
        Number of nodes in theta and in phi; by default enough to be exact to rounding. Fewer are
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
    frequency_mhz: Scalar, lmax: int, monopoles: Monopoles, stokes: str, nodes: Any
) -> Float[Array, "products modes"]:
    grid = HemisphereGrid.gauss_legendre(*nodes) if nodes else HemisphereGrid.for_lmax(lmax)
    return beam_fields.product_modes(monopoles.fields(frequency_mhz, grid), lmax, stokes=stokes)


# access to each parameter of the antennas, and the ends of its domain
PARAMETERS: Mapping[str, tuple[Callable[[Monopoles], Float[Array, ""]], float, float]] = {
    "length_m": (lambda m: m.length_m, 0.0, np.inf),
    "zenith_angle_deg": (lambda m: m.zenith_angle_deg, 0.0, 180.0),
    "height_m": (lambda m: m.height_m, 0.0, np.inf),
    "turntable_offset_deg": (lambda m: m.turntable_offset_deg, -np.inf, np.inf),
    "surface_permittivity": (lambda m: m.regolith.surface_permittivity, 1.0, np.inf),
    "deep_permittivity": (lambda m: m.regolith.deep_permittivity, 1.0, np.inf),
    "loss_tangent": (lambda m: m.regolith.loss_tangent, 0.0, np.inf),
}


# rotations keep |n| = 1 to rounding; a larger deviation is a mistake
UNIT_TOLERANCE = 1e-9


def beams_towards(
    frequency_mhz: Scalar,
    directions: Vectors,
    monopoles: Monopoles | None = None,
    *,
    stokes: str = "I",
) -> Patterns:
    """Return the beams B_k(n) of the embedded antennas in the directions n.

    A source of x K sr in direction n adds x B_k(n) kelvin to product k (for ``stokes`` V, x is the
    integral of V over the source). Differentiable in every parameter of ``monopoles``, also below
    the horizon, and in the directions, except at the zenith, where theta and phi have no slope.

    Parameters
    ----------
    frequency_mhz : float
    directions : (directions, 3) array
        Unit vectors: East, North, up in the frame of the antennas.
    monopoles : Monopoles, optional
        By default the paper's four arms on its ground.
    stokes : {"I", "Q", "U", "V"}
        Q and U refer to the directions of increasing theta and phi; at the zenith, to East and
        North.

    Returns
    -------
    (products, directions) array
        In 1/sr, with the normalisation of :func:`monopole_beams`; zero where up <= 0.

    Raises
    ------
    InputError
        For a frequency that is not positive, vectors whose length is not one, or an unknown Stokes
        parameter.
    """
    require_positive("frequency_mhz", frequency_mhz)
    require_array("directions", directions, (None, 3))
    if not is_traced(directions):
        length = np.linalg.norm(np.asarray(directions), axis=1)
        if (bad := np.flatnonzero(np.abs(length - 1.0) > UNIT_TOLERANCE)).size:
            raise InputError(
                f"directions must be unit vectors, number {bad[0]} has length {length[bad[0]]:.6g}"
            )
    monopoles = Monopoles() if monopoles is None else monopoles
    # an array: one compilation for all frequencies
    return _patterns(_array(frequency_mhz), directions, monopoles, stokes)


@compiled
def _patterns(
    frequency_mhz: Scalar, directions: Vectors, monopoles: Monopoles, stokes: str
) -> Patterns:
    visible = directions[:, 2] > 0.0
    # a visible direction replaces the hidden ones, for finite fields and derivatives
    xp = namespace(frequency_mhz, directions, monopoles)
    east, north, up = xp.where(visible[:, None], directions, np.array([0.6, 0.0, 0.8])[None]).T
    theta, phi = xp.arctan2(xp.hypot(east, north), up), xp.arctan2(north, east)
    fields = monopoles.towards(frequency_mhz, theta, phi)
    patterns = to_real(beam_fields.stokes_pairs(*fields, stokes))
    # the autos' integral is converged on the coarsest grid
    whole = monopoles.fields(frequency_mhz, HemisphereGrid.for_lmax(0))
    scale = beam_fields.mean_auto_integral(whole)
    return xp.where(visible[None], patterns / scale, 0.0)


def source_response(
    observation: Observation,
    galactic: Float[np.ndarray, "..."],
    frequency_mhz: Scalar,
    antennas: BeamSource | None = None,
    *,
    stokes_v: float | Float[Array, ""] = 0.0,
) -> Float[Array, "products times"]:
    """Return the visibilities of a source of 1 K sr at every sample.

    V_k(t) = B_k^I(n(t)) + stokes_v B_k^V(n(t)), since I = 1 K sr and V = stokes_v I. Multiply by
    the flux in K sr, constant or (times,). Differentiable in ``stokes_v`` and in
    the embedded antennas.

    Parameters
    ----------
    observation : Observation
    galactic : (3,) or (times, 3) array
        As for :meth:`.Observation.antenna_directions`.
    frequency_mhz : float
    antennas : BeamSource, optional
        By default the paper's.
    stokes_v : float
        V / I with the IAU's sign. If it is positive, a receiver that looks towards the source
        sees the electric field turn counter-clockwise (right-handed).

    Returns
    -------
    (products, times) array
        In K; zero while the source is below the horizon.

    Raises
    ------
    InputError
        As :meth:`.Observation.antenna_directions`; for vectors whose length is not one, a frequency
        that is not positive, or ``|stokes_v| > 1``.
    """
    if not is_traced(stokes_v) and not abs(stokes_v) <= 1.0:
        raise InputError(f"stokes_v is the fraction V / I, from -1 to 1, got {stokes_v}")
    directions = observation.antenna_directions(galactic)
    antennas = Monopoles() if antennas is None else antennas
    response = antennas.response(frequency_mhz, directions)
    if not is_traced(stokes_v) and stokes_v == 0.0:
        return response
    return response + stokes_v * antennas.response(frequency_mhz, directions, "V")
