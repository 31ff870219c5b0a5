"""Real spherical harmonics: packing, transforms, spectra, quadratic forms and rotations.

A real field is f = sum_c a_c y_c with the orthonormal real harmonics ::

    y_l0 = Y_l0,   y_lm = sqrt(2) Re Y_lm,   y_l,-m = -sqrt(2) Im Y_lm     (m > 0)

so that a_l0 = a_l0 (complex convention), a_lm = sqrt(2) Re a_lm, a_l,-m = sqrt(2) Im a_lm. Modes
are packed at index ell^2 + ell + m, m = -ell..ell; a smaller lmax is a slice. An isotropic field
has variance C_ell in every coefficient. Y_lm as in healpy (Condon-Shortley phase included).

**Quadratic forms** are y^T C y in every direction (:func:`order_products`). On a ring, y_lm =
lambda_l|m|(theta) f_m(phi), so C first reduces to one matrix over m and m' for all points of the
ring. This takes N_modes^2 operations per ring, where products with y take N_modes^2 per point. A
ring and its mirror image in the south, where lambda has the sign (-1)^(l + m), share half of them.

**Rotations** are orthogonal matrices, block-diagonal in ell. D(g) rotates a field: (D(g) f)(n) =
f(g^-1 n), so that D(g h) = D(g) D(h). For the rotation vector w (axis times angle), D = exp(w . K).
K_x, K_y and K_z are the real antisymmetric generators, i.e. -i times the angular momentum operators
in this basis. K_z couples only m with -m, K_x and K_y only ``|m|`` with ``|m| +- 1``.
"""

from __future__ import annotations

from functools import lru_cache

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Complex, Float, Int

from lusee_bayes.core.arrays import Array, Fields, Square, namespace, read_only
from lusee_bayes.core.checks import require_finite, require_plain, require_whole
from lusee_bayes.core.errors import InputError
from lusee_bayes.core.lazy import healpy, rotations, special

SQRT2 = np.sqrt(2.0)
Angles = Float[np.ndarray, " points"]
AtPoints = Float[np.ndarray, "points modes"]
# beyond these, C libraries run out of index range or memory
LARGEST_LMAX, LARGEST_NSIDE = 2047, 2048


def require_nside(nside: object) -> None:
    """Raise InputError unless it is the NSIDE of a HEALPix map."""
    require_whole("nside", nside, 1, LARGEST_NSIDE)
    if not healpy.isnsideok(nside, nest=True):
        raise InputError(f"nside is {nside}, expected a power of two; use 64, for example")


def n_modes(lmax: int) -> int:
    """Return the number of real coefficients up to ``lmax``: (lmax + 1)^2."""
    return (lmax + 1) ** 2


def lmax_of(n: int) -> int:
    """Return the lmax that has ``n`` modes.

    Raises
    ------
    InputError
        If ``n`` is not a square number.
    """
    lmax = round(np.sqrt(n)) - 1
    if n < 1 or n_modes(lmax) != n:
        raise InputError(f"{n} coefficients do not match any lmax: expected a square number")
    return lmax


@lru_cache(maxsize=16)
def mode_numbers(lmax: int) -> tuple[np.ndarray, np.ndarray]:
    """Return ``ell`` and ``m`` of every packed mode, two integer arrays of shape (modes,)."""
    require_whole("lmax", lmax, 0, LARGEST_LMAX)
    ell = np.repeat(np.arange(lmax + 1), 2 * np.arange(lmax + 1) + 1)
    return read_only(ell, np.arange(n_modes(lmax)) - ell * (ell + 1))


def from_healpy(alm: Complex[np.ndarray, "*batch alms"]) -> Float[np.ndarray, "*batch modes"]:
    """Convert complex coefficients in healpy's packing (m >= 0, m-major) to real packed ones."""
    lmax = healpy.Alm.getlmax(alm.shape[-1])
    ell, m = mode_numbers(lmax)
    picked = alm[..., healpy.Alm.getidx(lmax, ell, np.abs(m))]
    return np.where(m == 0, picked.real, SQRT2 * np.where(m > 0, picked.real, picked.imag))


def to_healpy(modes: Float[Array, "*batch modes"]) -> Complex[np.ndarray, "*batch alms"]:
    """Convert real packed coefficients to healpy's; inverse of :func:`from_healpy`."""
    modes = np.asarray(modes)
    ell, m = healpy.Alm.getlm(lmax_of(modes.shape[-1]))
    centre = ell * (ell + 1)
    alm = (modes[..., centre + m] + 1j * modes[..., centre - m]) / SQRT2
    return np.where(m == 0, modes[..., centre] + 0j, alm)


def map_to_modes(pixels: Float[np.ndarray, " pixels"], lmax: int) -> Float[np.ndarray, " modes"]:
    """Analyse a HEALPix map by healpy's iterated quadrature.

    Parameters
    ----------
    pixels : (pixels,) array
        In RING order.
    lmax : int

    Returns
    -------
    (modes,) array
        Real packed coefficients up to ``lmax``, in the unit of the map.

    Raises
    ------
    InputError
        If the map has no valid NSIDE, a unit, a mask, NaN or UNSEEN pixels, or is too coarse
        (lmax > 3 NSIDE - 1), or if lmax is negative or not an integer.
    """
    require_whole("lmax", lmax, 0, LARGEST_LMAX)
    require_plain("the map", pixels)
    pixels = np.asarray(pixels, dtype=np.float64)
    if not healpy.isnpixok(pixels.size):
        raise InputError(f"{pixels.size} pixels are not a HEALPix map: expected 12 NSIDE^2")
    require_finite("the map", pixels)
    if healpy.mask_bad(pixels).any():
        raise InputError("the map has UNSEEN pixels, which are no temperatures; fill them first")
    nside = healpy.npix2nside(pixels.size)
    if lmax > 3 * nside - 1:
        raise InputError(
            f"lmax = {lmax} is too large for a map of NSIDE {nside}, which supports lmax <= "
            f"{3 * nside - 1}; lower lmax or give a finer map"
        )
    return from_healpy(healpy.map2alm(pixels, lmax=lmax, iter=10))


def modes_to_map(modes: Fields, nside: int) -> Float[np.ndarray, "*batch pixels"]:
    """Synthesise the HEALPix RING maps of packed coefficients."""
    require_nside(nside)
    alm, lmax = to_healpy(modes), lmax_of(np.shape(modes)[-1])
    maps = [healpy.alm2map(one, nside, lmax=lmax) for one in np.atleast_2d(alm)]
    return np.reshape(maps, (*alm.shape[:-1], -1))


@lru_cache(maxsize=8)
def _polar_functions(theta: tuple[float, ...], lmax: int) -> np.ndarray:
    """Y_lm at azimuth zero for every packed mode; it depends on m only through ``|m|``."""
    ell, m = mode_numbers(lmax)
    table = special.sph_legendre_p_all(lmax, lmax, np.array(theta))[0]
    return read_only(np.ascontiguousarray(table[ell, np.abs(m)].T))[0]


def polar_functions(theta: Angles, lmax: int) -> AtPoints:
    """Return lambda_lm(theta), the Y_lm at azimuth zero, for ``|m|`` of every packed mode."""
    return _polar_functions(tuple(np.asarray(theta, dtype=float).ravel()), lmax)


def azimuth_functions(phi: Angles, lmax: int) -> Float[np.ndarray, "points orders"]:
    """Return the azimuthal factor of y for m = -lmax..lmax: -sqrt(2) sin, 1, sqrt(2) cos."""
    angle = np.asarray(phi, dtype=float)[:, None] * np.arange(1, lmax + 1)
    sine, cosine = -SQRT2 * np.sin(angle)[:, ::-1], SQRT2 * np.cos(angle)
    return np.concatenate([sine, np.ones((len(angle), 1)), cosine], axis=1)


def synthesis_matrix(theta: Angles, phi: Angles, lmax: int) -> AtPoints:
    """Return the real harmonics in given directions: f(theta_i, phi_i) = sum_c matrix[i, c] a_c.

    Each distinct theta is computed only once, which makes HEALPix rings cheap.

    Parameters
    ----------
    theta, phi : (points,) array
        In radians; theta from the pole.
    lmax : int

    Returns
    -------
    (points, modes) array
    """
    rings, ring_of_point = np.unique(np.asarray(theta, dtype=float), return_inverse=True)
    _, m = mode_numbers(lmax)
    matrix = polar_functions(rings, lmax)[ring_of_point]
    matrix *= azimuth_functions(phi, lmax)[:, m + lmax]
    return matrix


def harmonics_at(lon_deg: float | Angles, lat_deg: float | Angles, lmax: int) -> AtPoints:
    """The harmonics at places in degrees, one row for each."""
    theta = np.radians(90.0 - np.atleast_1d(lat_deg))
    return synthesis_matrix(theta, np.radians(np.atleast_1d(lon_deg)), lmax)


def pixel_matrix(nside: int, lmax: int) -> Float[np.ndarray, "pixels modes"]:
    """Return :func:`synthesis_matrix` at the centres of HEALPix RING pixels."""
    require_nside(nside)
    return synthesis_matrix(*healpy.pix2ang(nside, np.arange(healpy.nside2npix(nside))), lmax)


# what the Gaussian beam that drawn maps are smoothed with leaves of ell = lmax
LEFT_AT_LMAX = 0.1


def taper(lmax: int, top: int | None = None) -> Float[np.ndarray, " ells"]:
    """Return a map's beam at ell = 0..top (by default lmax): exp(-ell (ell + 1) sigma^2 / 2)."""
    ell = np.arange((lmax if top is None else top) + 1)
    return LEFT_AT_LMAX ** (ell * (ell + 1.0) / max(lmax * (lmax + 1.0), 1.0))


def taper_fwhm_deg(lmax: int) -> float:
    """Return the beam's full width at half maximum in degrees; ``lmax`` is at least 1."""
    sigma = np.sqrt(-2.0 * np.log(LEFT_AT_LMAX) / (lmax * (lmax + 1.0)))
    return float(np.degrees(sigma * np.sqrt(8.0 * np.log(2.0))))


def averaging_rows(
    inside: Bool[np.ndarray, "regions pixels"], lmax: int
) -> Float[np.ndarray, "regions modes"]:
    """Rows that average a field over regions: the means of the harmonics over their pixels.

    Parameters
    ----------
    inside : (regions, pixels) array
        Whether a HEALPix RING pixel belongs to a region.
    lmax : int

    Returns
    -------
    (regions, modes) array
        Zero for a region without pixels; exact for the whole sphere.
    """
    n, options = inside.shape[1], {"lmax": lmax, "iter": 0, "use_pixel_weights": False}
    sums = [from_healpy(healpy.map2alm(one.astype(np.float64), **options)) for one in inside]
    rows = np.stack(sums) * n / (4.0 * np.pi * np.fmax(inside.sum(1), 1))[:, None]
    rows[inside.all(1)] = np.eye(1, rows.shape[1]) / np.sqrt(4.0 * np.pi)
    return rows


def sum_over_m(values: Fields) -> Float[np.ndarray, "*batch ells"]:
    """Sum a per-mode quantity over the modes of each ell = 0..lmax."""
    lmax = lmax_of(values.shape[-1])
    return np.add.reduceat(np.asarray(values), np.arange(lmax + 1) ** 2, axis=-1)


def mean_over_m(values: Fields) -> Float[np.ndarray, "*batch ells"]:
    """Average a per-mode quantity over the modes of each ell = 0..lmax."""
    return sum_over_m(values) / (2.0 * np.arange(lmax_of(values.shape[-1]) + 1) + 1.0)


def power_spectrum(modes: Fields) -> Float[np.ndarray, "*batch ells"]:
    """Return C_ell = sum_m a_lm^2 / (2 ell + 1) for ell = 0..lmax; the mean is not subtracted."""
    return mean_over_m(np.asarray(modes) ** 2)


def per_mode(spectrum: Float[Array, "*batch ells"]) -> Fields:
    """Repeat a per-ell quantity for every mode of that ell."""
    ell, _ = mode_numbers(spectrum.shape[-1] - 1)
    return spectrum[..., ell]


@lru_cache(maxsize=8)
def modes_by_size_of_order(lmax: int) -> Int[np.ndarray, " modes"]:
    """Order packed modes by ``|m|``; for each, first the a_lm, then the a_l,-m, both by ell."""
    ell, m = mode_numbers(lmax)
    return read_only(np.lexsort((ell, m < 0, np.abs(m))))[0]


def order_products(matrix: Square, heights: Angles) -> Float[np.ndarray, "points orders orders"]:
    """Compute B of every ring, where y^T C y = f(phi)^T B f(phi) and f are the azimuth functions.

    Parameters
    ----------
    matrix : (modes, modes) array
        C, symmetric, over real harmonics.
    heights : (rings,) array
        theta of each ring in radians, increasing and symmetric about the equator.

    Returns
    -------
    (rings, orders, orders) array
        Over m = -lmax..lmax; not symmetric: only its sum with its transpose matters.
    """
    lmax = lmax_of(matrix.shape[0])
    # the remaining rings are southern mirror images
    polar = polar_functions(heights[: (len(heights) + 1) // 2], lmax)
    by_order, first = modes_by_order(lmax)
    ell, m = mode_numbers(lmax)
    polar, odd = polar[:, by_order], ((ell + m) % 2 == 1)[by_order]
    mirrored = np.where(odd, -polar, polar)
    both = np.zeros((2 * lmax + 1, len(heights), 2 * lmax + 1))
    for order, rows in enumerate(np.split(np.arange(len(m)), first[1:])):
        # the matrix is symmetric: entries with m < m' count twice, those with m > m' are omitted
        begin, starts = rows[0], first[order:] - rows[0]
        block = matrix[by_order[rows]].take(by_order[begin:], axis=1)
        block[:, len(rows) :] *= 2.0
        even_part, odd_part = (polar[:, rows[x]] @ block[x] for x in (~odd[rows], odd[rows]))
        # the equator is its own mirror image
        north, south = both[order, : len(polar)], both[order, ::-1][: len(polar)]
        total = even_part + odd_part
        total *= polar[:, begin:]
        north[:, order:] = np.add.reduceat(total, starts, axis=1)
        np.subtract(even_part, odd_part, out=total)
        total *= mirrored[:, begin:]
        south[:, order:] = np.add.reduceat(total, starts, axis=1)
    return both.transpose(1, 0, 2)


def modes_by_order(lmax: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the packed modes ordered by m, and the position where each m begins."""
    _, m = mode_numbers(lmax)
    by_order = np.argsort(m, kind="stable")
    return by_order, np.searchsorted(m[by_order], np.arange(-lmax, lmax + 1))


@lru_cache(maxsize=512)
def generators(ell: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return K_x, K_y, K_z within one ell, each (2 ell + 1, 2 ell + 1) with rows m = -ell..ell.

    They follow from ``(J_+ a)_m = alpha_m a_(m-1)`` and ``(J_- a)_m = alpha_(m+1) a_(m+1)``, with
    alpha_m = sqrt((ell + m)(ell - m + 1)), written for c_m = sqrt(2) Re a_m, s_m = sqrt(2) Im a_m.
    """
    k_x, k_y, k_z = np.zeros((3, 2 * ell + 1, 2 * ell + 1))
    m = np.arange(1, ell + 1)
    cosine, sine = ell + m, ell - m
    k_z[cosine, sine], k_z[sine, cosine] = m, -m
    # coupling of row m to m - 1; a_0 is real, so its coefficient has no factor sqrt(2)
    lowering = np.sqrt((ell + m) * (ell - m + 1.0)) / 2
    lowering[:1] *= np.sqrt(2.0)
    k_y[cosine, cosine - 1] = -lowering
    k_y[sine[1:], sine[1:] + 1] = -lowering[1:]
    k_x[cosine[1:], sine[1:] + 1] = lowering[1:]
    k_x[sine, cosine - 1] = -lowering
    return read_only(k_x - k_x.T, k_y - k_y.T, k_z)


class Rotation(eqx.Module):
    """An orthogonal matrix on packed modes.

    Attributes
    ----------
    blocks : tuple of (2 ell + 1, 2 ell + 1) array
        One for each ell = 0..lmax.
    """

    blocks: tuple[Float[Array, "_ _"], ...]

    @classmethod
    def from_matrix(cls, matrix: Float[np.ndarray, "3 3"], lmax: int) -> Rotation:
        """Return D(g) for the proper rotation matrix g that maps vectors n to g n.

        Results are cached, since all channels of a site need the same rotations.
        """
        return _rotation(np.ascontiguousarray(matrix, dtype=np.float64).tobytes(), lmax)

    @property
    def T(self) -> Rotation:
        """The inverse rotation."""
        return Rotation(tuple(b.T for b in self.blocks))

    def __call__(self, modes: Fields) -> Fields:
        """Rotate the field, or fields, with these coefficients."""
        turned = [modes[..., ell**2 : (ell + 1) ** 2] @ d.T for ell, d in enumerate(self.blocks)]
        return namespace(modes, self).concatenate(turned, axis=-1)


@lru_cache(maxsize=16)
def _rotation(matrix: bytes, lmax: int) -> Rotation:
    turn = rotations.Rotation.from_matrix(np.frombuffer(matrix).reshape(3, 3)).as_rotvec()
    angle = np.linalg.norm(turn)
    axis, blocks = turn / angle if angle else turn, []
    for ell in range(lmax + 1):
        # the eigenvalues of i axis . K are integers
        values, vectors = np.linalg.eigh(1j * np.tensordot(axis, generators(ell), 1))
        blocks.append(np.real((vectors * np.exp(-1j * angle * np.rint(values))) @ vectors.conj().T))
    return Rotation(tuple(blocks))


def turn_about_z(modes: Fields, angle: float | Float[Array, ""]) -> Fields:
    """Rotate fields about z.

    Parameters
    ----------
    modes : (..., modes) array
        Real packed coefficients.
    angle : float
        In radians, positive from x towards y; differentiable.

    Returns
    -------
    (..., modes) array
    """
    ell, m = mode_numbers(round(np.sqrt(modes.shape[-1])) - 1)
    mirrored = modes[..., ell * (ell + 1) - m]
    xp, angles = namespace(modes, angle), m.astype(np.float64) * angle
    shape = (1,) * (modes.ndim - 1) + (-1,)
    return modes * xp.cos(angles).reshape(shape) + mirrored * xp.sin(angles).reshape(shape)


def turn_about(axis: int, modes: Fields, angle: float | Float[Array, ""]) -> Fields:
    """Rotate fields about x (axis 0), from y towards z, or about y (1), from z towards x.

    Otherwise as :func:`turn_about_z`.
    """
    # maps the axis to z by a cyclic permutation of the axes
    swap, lmax = np.roll(np.eye(3), -(axis + 1), axis=1).T, round(np.sqrt(modes.shape[-1])) - 1
    from_axis = Rotation.from_matrix(swap, lmax)
    return from_axis.T(turn_about_z(from_axis(modes), angle))


@lru_cache(maxsize=16)
def _horizontal_generators(lmax: int) -> tuple[np.ndarray, np.ndarray]:
    """K_x and K_y over all packed modes, as two columns and their weights for every row.

    A row (ell, m) has at most two non-zero entries, in columns (ell, +-(|m| +- 1)).
    """
    columns = np.zeros((2, n_modes(lmax), 2), dtype=int)
    weights = np.zeros((2, n_modes(lmax), 2))
    for ell in range(lmax + 1):
        for axis, k in enumerate(generators(ell)[:2]):
            order = np.argsort(-np.abs(k), axis=1, kind="stable")[:, :2]
            rows, width = slice(ell**2, (ell + 1) ** 2), order.shape[1]
            columns[axis, rows, :width] = ell**2 + order
            weights[axis, rows, :width] = np.take_along_axis(k, order, axis=1)
    return columns, weights


def apply_generator(modes: Fields, axis: int) -> Fields:
    """Return K_x (axis 0) or K_y (axis 1) times packed modes, in time linear in their number."""
    columns, weights = _horizontal_generators(round(np.sqrt(modes.shape[-1])) - 1)
    first, second = (weights[axis, :, i].reshape((1,) * (modes.ndim - 1) + (-1,)) for i in (0, 1))
    return first * modes[..., columns[axis, :, 0]] + second * modes[..., columns[axis, :, 1]]


def tilts(modes: Fields, order: int) -> list[Fields]:
    """Return the Taylor terms W_ab of a tilt, in the order of :func:`tilt_powers`.

    ::

        exp(ex K_x + ey K_y) f = sum_ab ex^a ey^b / (a + b)! W_ab,
        W_ab = K_x W_(a-1)b + K_y W_a(b-1),   W_00 = f.

    Parameters
    ----------
    modes : (..., modes) array
        Real packed coefficients of f.
    order : int
        Highest a + b.

    Returns
    -------
    list of (..., modes) array
    """
    terms = {(0, 0): modes}
    for a, b in tilt_powers(order)[1:]:
        left = apply_generator(terms[a - 1, b], 0) if a else 0.0
        terms[a, b] = left + (apply_generator(terms[a, b - 1], 1) if b else 0.0)
    return list(terms.values())


def tilt_powers(order: int) -> list[tuple[int, int]]:
    """Return the powers (a, b) of (ex, ey) up to total degree ``order``, lowest degree first."""
    return [(n - b, b) for n in range(order + 1) for b in range(n + 1)]
