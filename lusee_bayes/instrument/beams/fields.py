"""Fields of antennas on the sphere, and the beams of products computed from them.

**Quadrature.** Beams end at the horizon. Gauss-Legendre nodes in cos theta over [0, 1] never see
the cut, so harmonic coefficients converge exponentially, whereas pixel sums ring. Azimuths are
uniform: a Fourier sum over them is exact up to aliasing.

**HEALPix pixels** are interpolated to other directions above the horizon. A ring of pixels is a
Fourier series in phi. Order m of a smooth function continues across the zenith as
f_m(-theta) = (-1)^m f_m(theta), and is zero there unless m is. So splines in theta need no boundary
condition at the zenith, and no rings with too few pixels for an order (ring number i has 4 i). The
error is that of cubic splines with ring spacings of at most h = 1 / NSIDE: 5/384 (h l)^4 for a
pattern of degree l, and up to 35 times that in the last step to the horizon, which is extrapolated.
In the first ring orders 3 alias to orders 1, by (h l)^3 / 43 of the pattern there.
"""

from __future__ import annotations

from typing import Literal

import equinox as eqx
import numpy as np
import scipy
from jaxtyping import Complex, Float, Inexact

from lusee_bayes.core import checks, lazy
from lusee_bayes.core.arrays import Array, namespace
from lusee_bayes.core.errors import InputError, require_known
from lusee_bayes.core.harmonics import LARGEST_LMAX, SQRT2, lmax_of, mode_numbers, polar_functions
from lusee_bayes.instrument.products import antennas_of, auto_indices, labels_of, to_real

# responses of antennas, and of pairs of them, in any directions
Fields = Complex[Array, "antennas *directions"]
Pairs = Complex[Array, "antennas antennas *directions"]
Pattern = Complex[np.ndarray, "theta phi"]
Angles = Float[np.ndarray, " theta"]
Frequencies = Float[np.ndarray, " frequencies"]


class HemisphereGrid(eqx.Module):
    """Directions above the horizon and their quadrature weights.

    Frame: topocentric, theta from the zenith, phi from East towards North.

    Attributes
    ----------
    theta : (theta,) array
        In radians.
    weights : (theta,) array
        Such that sum_theta sum_phi weights * 2 pi / n_phi = 2 pi.
    n_phi : int
        Number of azimuths phi_k = 2 pi k / n_phi.
    """

    theta: Float[np.ndarray, " theta"]
    weights: Float[np.ndarray, " theta"]
    n_phi: int = eqx.field(static=True)

    @classmethod
    def gauss_legendre(cls, n_theta: int, n_phi: int) -> HemisphereGrid:
        """Return a grid, exact for polynomials in cos theta up to degree 2 n_theta - 1."""
        nodes, weights = scipy.special.roots_legendre(n_theta)
        return cls(np.arccos((nodes[::-1] + 1.0) / 2.0), weights[::-1] / 2.0, n_phi)

    @classmethod
    def for_lmax(cls, lmax: int) -> HemisphereGrid:
        """Return a grid that is fine enough for harmonics up to ``lmax`` of the embedded antennas.

        Their coefficients change by less than 1e-11 of the largest when the number of nodes
        doubles (tests/instrument/test_monopoles.py). A loss tangent below 0.001 needs more nodes,
        since echoes from deep layers then vary quickly with the angle.
        """
        checks.require_whole("lmax", lmax, 0, LARGEST_LMAX)
        n = max(lmax, 63) + 1
        return cls.gauss_legendre(2 * n, 2 * n)

    @property
    def phi(self) -> Float[np.ndarray, " phi"]:
        """Azimuths in radians."""
        return 2.0 * np.pi * np.arange(self.n_phi) / self.n_phi

    def polar_weights(self, lmax: int) -> Float[np.ndarray, "theta modes"]:
        """Return the weight of the Fourier sum at each theta in every coefficient: w lambda_lm."""
        return polar_functions(self.theta, lmax) * self.weights[:, None]

    def integrate(self, f: Float[Array, "*batch theta phi"]) -> Float[Array, "*batch"]:
        """Integrate over the hemisphere; the result is in units of f times steradian."""
        return (f.sum(-1) @ self.weights) * (2.0 * np.pi / self.n_phi)

    def modes(self, f: Float[Array, "*batch theta phi"], lmax: int) -> Float[Array, "*batch modes"]:
        """Return the harmonic coefficients of a function that is zero below the horizon.

        a_lm = sum_theta w lambda_lm(theta) sum_phi f exp(-i m phi) 2 pi / n_phi.

        Parameters
        ----------
        f : (..., theta, phi) array
            The function on this grid.
        lmax : int

        Returns
        -------
        (..., modes) array
            Real packed coefficients.

        Raises
        ------
        InputError
            If ``f`` does not match the grid, or the grid has too few azimuths for ``lmax``.
        """
        checks.require_shape("the field", f, (*f.shape[:-2], len(self.theta), self.n_phi))
        if self.n_phi <= 2 * lmax:
            wrong = f"{self.n_phi} azimuths cannot resolve lmax = {lmax}; give more than {2 * lmax}"
            raise InputError(wrong)
        ell, m = mode_numbers(lmax)
        xp = namespace(f)
        fourier = xp.fft.rfft(f, axis=-1)[..., : lmax + 1] * (2.0 * np.pi / self.n_phi)
        sines, cosines = SQRT2 * fourier.imag[..., :0:-1], SQRT2 * fourier.real[..., 1:]
        parts = xp.concatenate([sines, fourier.real[..., :1], cosines], axis=-1)
        # multiply every order by its functions of theta, which are zero where there is no mode
        polar = np.zeros((2 * lmax + 1, len(self.theta), lmax + 1))
        polar[m + lmax, :, ell] = self.polar_weights(lmax).T
        by_order = xp.moveaxis(parts, -1, 0).reshape(2 * lmax + 1, -1, len(self.theta)) @ polar
        return xp.moveaxis(by_order[m + lmax, :, ell], 0, -1).reshape(*f.shape[:-2], -1)


class AntennaFields(checks.Described, eqx.Module):
    """Complex response of each antenna to a wave arriving from each direction of a grid.

    Frame: topocentric, theta from the zenith, phi from East towards North. The time convention is
    exp(+i w t).

    Attributes
    ----------
    e_theta, e_phi : (antennas, theta, phi) complex array
        Response to the theta and phi components of the incident field, in one unit and with one
        phase centre for all antennas.
    grid : HemisphereGrid
    """

    e_theta: Complex[Array, "antennas theta phi"]
    e_phi: Complex[Array, "antennas theta phi"]
    grid: HemisphereGrid

    def __check_init__(self):
        expected = (None, len(self.grid.theta), self.grid.n_phi)
        for name, field in (("e_theta", self.e_theta), ("e_phi", self.e_phi)):
            checks.require_shape(name, field, expected)
            expected = field.shape
            if field.dtype != np.complex128:
                raise InputError(
                    f"{name} must be a complex128 array, got {field.dtype}; "
                    "convert it with numpy.asarray(x, dtype=numpy.complex128)"
                )

    def description(self) -> tuple[str, ...]:
        n_theta, n_phi = len(self.grid.theta), self.grid.n_phi
        angles = f"{n_theta} angles from zenith to horizon x {n_phi} azimuths"
        what = f"E_theta and E_phi of {self.n_antennas} antennas, complex"
        return what, f"{angles}, from East towards North"

    @property
    def n_antennas(self) -> int:
        """Number of antennas."""
        return self.e_theta.shape[0]


# between the frequencies of a file: luseepy's rule (linear in products of fields and in
# impedances), or cubic splines through fields and impedances
Interpolation = Literal["linear", "spline"]
# frequencies that differ by less are equal, as in luseepy; a header stores 15 digits
SAME_FREQUENCY_MHZ = 1e-6


def place_of(what: str, known_mhz: Frequencies, frequency_mhz: float) -> int:
    """Return the index of a frequency among known ones; InputError if it is not among them."""
    nearest = int(np.argmin(np.abs(known_mhz - frequency_mhz)))
    if abs(known_mhz[nearest] - frequency_mhz) > SAME_FREQUENCY_MHZ:
        raise InputError(
            f"{what} at {frequency_mhz:.15g} MHz (it has "
            f"{', '.join(f'{f:.9g}' for f in known_mhz)}); use --set frequency_mhz="
            f"{known_mhz[nearest]:.15g}"
        )
    return nearest


def neighbours(path: str, known_mhz: Frequencies, frequency_mhz: float) -> list[tuple[int, float]]:
    """Return the frequencies of a file that linear interpolation uses, and their weights.

    Parameters
    ----------
    path : str
        File that the frequencies come from, for the error message.
    known_mhz : (frequencies,) array
        Increasing.
    frequency_mhz : float

    Returns
    -------
    list of (int, float)
        Index and weight: one pair if the file has the frequency, else two.

    Raises
    ------
    InputError
        If the frequency is outside the known ones.
    """
    nearest = int(np.argmin(np.abs(known_mhz - frequency_mhz)))
    if abs(known_mhz[nearest] - frequency_mhz) <= SAME_FREQUENCY_MHZ:
        return [(nearest, 1.0)]
    if not known_mhz[0] < frequency_mhz < known_mhz[-1]:
        raise InputError(
            f"{path}: frequencies from {known_mhz[0]:g} to {known_mhz[-1]:g} MHz, not at "
            f"{frequency_mhz:.12g}; change frequency_mhz, or give a file that covers it"
        )
    above = int(np.searchsorted(known_mhz, frequency_mhz))
    low, high = known_mhz[above - 1], known_mhz[above]
    part = float((frequency_mhz - low) / (high - low))
    return [(above - 1, 1.0 - part), (above, part)]


def at_frequency(
    path: str,
    known_mhz: Frequencies,
    frequency_mhz: float,
    *parts: np.ndarray,
    rule: Interpolation = "linear",
) -> list[np.ndarray]:
    """Interpolate arrays in frequency.

    Parameters
    ----------
    path : str
        File that the arrays come from, for the error message.
    known_mhz : (frequencies,) array
        Increasing.
    frequency_mhz : float
    *parts : (frequencies, ...) array
    rule : {"linear", "spline"}

    Returns
    -------
    list of array
        The parts at ``frequency_mhz``, without their first axis; exactly the file's values if it
        has this frequency.

    Raises
    ------
    InputError
        If the frequency is outside the known ones.
    """
    places = neighbours(path, known_mhz, frequency_mhz)
    if len(places) == 1 or rule == "linear":
        return [np.asarray(sum(weight * part[k] for k, weight in places)) for part in parts]
    degree = min(3, len(known_mhz) - 1)
    splines = [scipy.interpolate.make_interp_spline(known_mhz, part, k=degree) for part in parts]
    return [np.asarray(spline(frequency_mhz)) for spline in splines]


def on_grid(rows: Pattern, theta: Angles, grid: HemisphereGrid, angle_deg: float = 0.0) -> Array:
    """Interpolate a pattern to a grid: splines in theta, Fourier sums in phi.

    Parameters
    ----------
    rows : (theta, phi) array
        The pattern at azimuths 2 pi k / n.
    theta : (theta,) array
        Angles of the pattern, in radians.
    grid : HemisphereGrid
        Target of the interpolation; directions that equal the pattern's are not interpolated.
    angle_deg : float
        How far to turn the pattern, from East towards North.

    Returns
    -------
    (grid_theta, grid_phi) array
    """
    same = len(grid.theta) == len(theta) and bool((grid.theta == theta).all())
    rows = rows if same else scipy.interpolate.CubicSpline(theta, rows)(grid.theta)
    n = rows.shape[1]
    steps = angle_deg * n / 360.0
    if grid.n_phi == n and steps == round(steps):
        return np.roll(rows, round(steps), axis=1)
    m, spectrum = np.fft.fftfreq(n, 1.0 / n), np.fft.fft(rows, axis=1) / n
    return spectrum @ np.exp(1j * m[:, None] * (grid.phi - np.radians(angle_deg))[None])


STOKES = ("I", "Q", "U", "V")


def stokes_beam(fields: AntennaFields, stokes: str = "I") -> Pairs:
    """Return :func:`stokes_pairs` of the fields, on their grid."""
    return stokes_pairs(fields.e_theta, fields.e_phi, stokes)


def stokes_pairs(e_theta: Fields, e_phi: Fields, stokes: str = "I") -> Pairs:
    """Return the response of <s_i conj(s_j)> to one Stokes parameter of the sky, for every pair.

    With E = E_i, F = E_j::

        I: (Et Ft* + Ep Fp*) / 2      Q: (Et Ft* - Ep Fp*) / 2
        U: (Et Fp* + Ep Ft*) / 2      V: i (Ep Ft* - Et Fp*) / 2

    from <e_a conj(e_b)> = [[I + Q, U - i V], [U + i V, I - Q]] / 2 in the basis (theta, phi), with
    exp(+i w t). V is the IAU's, right-handed minus left-handed: if it is positive, a receiver that
    looks towards the source sees the electric field turn counter-clockwise. The paper's U and
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
    require_known("unknown Stokes parameter", stokes, STOKES)
    et, ep = e_theta[:, None], e_phi[:, None]
    ft, fp = e_theta[None].conj(), e_phi[None].conj()
    if stokes == "I":
        return (et * ft + ep * fp) / 2.0
    if stokes == "Q":
        return (et * ft - ep * fp) / 2.0
    if stokes == "U":
        return (et * fp + ep * ft) / 2.0
    return 1j * (ep * ft - et * fp) / 2.0


class ProductBeams(checks.Described, eqx.Module):
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
        If the shape of ``modes`` matches no number of antennas or no lmax.
    """

    modes: Float[Array, "products modes"]
    frequency_mhz: float = eqx.field(static=True)

    def __check_init__(self):
        checks.require_float64("the beam coefficients", self.modes)
        lmax_of(self.modes.shape[-1])
        antennas_of(self.n_products)

    def description(self) -> tuple[str, ...]:
        integrals = self.modes[auto_indices(antennas_of(self.n_products)), 0] * np.sqrt(4.0 * np.pi)
        return (
            f"{self.n_products} products at {self.frequency_mhz:g} MHz, lmax = {self.lmax}",
            f"{self.modes.shape[1]} real coefficients each, topocentric, K per K: "
            f"{checks.listed(self.labels)}",
            f"integrals of the autos over the sky {checks.extent(integrals, 'sr K/K')}",
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
        return labels_of(self.n_products)


def product_modes(
    fields: AntennaFields, lmax: int, *, stokes: str = "I", normalise: bool = True
) -> Float[Array, "products modes"]:
    """Return the coefficients of the beams of all products of the antennas.

    Parameters
    ----------
    fields : AntennaFields
    lmax : int
    stokes : {"I", "Q", "U", "V"}
    normalise : bool
        Scale the beams so that the Stokes I autos integrate to one on average, which makes
        visibilities antenna temperatures in K. Otherwise the scale of the fields is kept.

    Returns
    -------
    (products, modes) array

    Raises
    ------
    InputError
        If the Stokes parameter is unknown or the grid is too coarse for ``lmax``.
    """
    patterns = to_real(stokes_beam(fields, stokes))
    if normalise:
        patterns = patterns / mean_auto_integral(fields)
    return fields.grid.modes(patterns, lmax)


def beam_scale(fields: AntennaFields, beams: ProductBeams) -> float:
    """Return the factor that turns products of fields, in any unit, into beams in K per K.

    Parameters
    ----------
    fields : AntennaFields
    beams : ProductBeams
        Of the same antennas: the mean integral of their autos sets the scale.
    """
    autos = beams.modes[auto_indices(fields.n_antennas), 0]
    return float(np.sqrt(4.0 * np.pi) * autos.mean() / mean_auto_integral(fields))


def mean_auto_integral(fields: AntennaFields) -> Float[Array, ""]:
    """Return the integral of the Stokes I auto beam in steradian, averaged over antennas."""
    integrals = fields.grid.integrate(to_real(stokes_beam(fields))[auto_indices(fields.n_antennas)])
    return namespace(integrals).asarray(integrals.mean())


def from_rings(
    pixels: Inexact[np.ndarray, "*batch pixels"], theta: Angles, phi: Float[np.ndarray, " phi"]
) -> Inexact[np.ndarray, "*batch theta phi"]:
    """Interpolate scalar functions from HEALPix RING pixels to a grid above the horizon.

    Only pixels with theta < 90 degrees are used.

    Parameters
    ----------
    pixels : (..., pixels) array
    theta : (theta,) array
        In radians, from the zenith, up to pi / 2.
    phi : (phi,) array
        In radians.

    Returns
    -------
    (..., theta, phi) array
        Complex if the pixels are.
    """
    nside = lazy.healpy.npix2nside(pixels.shape[-1])
    starts, sizes, *_ = lazy.healpy.ringinfo(nside, np.arange(1, 2 * nside))
    ring_theta, first_phi = lazy.healpy.pix2ang(nside, starts)
    orders = np.arange(1 - 2 * nside, 2 * nside)
    # f_m of every ring; orders for which a ring has too few pixels are not used
    series = np.zeros((*pixels.shape[:-1], len(sizes), len(orders)), dtype=np.complex128)
    for ring, (n, start) in enumerate(zip(sizes, starts, strict=True)):
        spectrum = np.fft.fft(pixels[..., start : start + n], axis=-1) / n
        series[..., ring, :] = spectrum[..., orders % n] * np.exp(-1j * orders * first_phi[ring])
    spread = np.empty((*pixels.shape[:-1], len(theta), len(orders)), dtype=np.complex128)
    for m in range(2 * nside):
        enough, both = np.flatnonzero(sizes > 2 * m), 2 * nside - 1 + np.unique([-m, m])
        rings = series[..., enough, :][..., both]
        # at the zenith every order but 0 is zero
        zenith = np.zeros(min(m, 1))
        none = np.zeros_like(rings[..., : zenith.size, :])
        nodes = [-ring_theta[enough][::-1], zenith, ring_theta[enough]]
        rings = np.concatenate([(-1.0) ** m * rings[..., ::-1, :], none, rings], axis=-2)
        spline = scipy.interpolate.CubicSpline(np.concatenate(nodes), rings, axis=-2)
        spread[..., both] = spline(theta)
    values = spread @ np.exp(1j * orders[:, None] * phi[None])
    return values if np.iscomplexobj(pixels) else values.real
