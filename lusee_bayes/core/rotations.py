"""Rotations of real spherical harmonics: orthogonal matrices, block-diagonal in ell.

D(g) turns a field: (D(g) f)(n) = f(g^-1 n), so that D(g h) = D(g) D(h). For the rotation vector w
(axis times angle) D = exp(w . K), with K_x, K_y, K_z the real antisymmetric generators, that is
-i times the angular momentum operators in the basis of :mod:`.harmonics`. K_z couples only m with
-m, K_x and K_y only ``|m|`` with ``|m| +- 1``.
"""

from __future__ import annotations

from functools import lru_cache

import equinox as eqx
import numpy as np
from jaxtyping import Float

from lusee_bayes.core.arrays import Array, namespace
from lusee_bayes.core.harmonics import mode_numbers, n_modes


@lru_cache(maxsize=512)
def generators(ell: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return K_x, K_y, K_z within one ell, each (2 ell + 1, 2 ell + 1) with rows m = -ell..ell.

    They follow from ``(J_+ a)_m = alpha_m a_(m-1)``, ``(J_- a)_m = alpha_(m+1) a_(m+1)``, with
    alpha_m = sqrt((ell + m)(ell - m + 1)), written for c_m = sqrt(2) Re a_m, s_m = sqrt(2) Im a_m.
    """
    k_x, k_y, k_z = np.zeros((3, 2 * ell + 1, 2 * ell + 1))
    m = np.arange(1, ell + 1)
    cosine, sine = ell + m, ell - m
    k_z[cosine, sine], k_z[sine, cosine] = m, -m
    # how m - 1 enters row m; with a_0 real its coefficient has no sqrt(2) to share
    lowering = np.sqrt((ell + m) * (ell - m + 1.0)) / 2
    lowering[:1] *= np.sqrt(2.0)
    k_y[cosine, cosine - 1] = -lowering
    k_y[sine[1:], sine[1:] + 1] = -lowering[1:]
    k_x[cosine[1:], sine[1:] + 1] = lowering[1:]
    k_x[sine, cosine - 1] = -lowering
    return k_x - k_x.T, k_y - k_y.T, k_z


@lru_cache(maxsize=512)
def _eigen_y(ell: int) -> tuple[np.ndarray, np.ndarray]:
    """Eigenvalues (exact integers) and vectors of the Hermitian i K_y within one ell."""
    values, vectors = np.linalg.eigh(1j * generators(ell)[1])
    return np.rint(values), vectors


def _block_y(ell: int, angle: float) -> np.ndarray:
    """exp(angle K_y) within one ell."""
    values, vectors = _eigen_y(ell)
    return np.real((vectors * np.exp(-1j * angle * values)) @ vectors.conj().T)


def _block_z(ell: int, angle: float) -> np.ndarray:
    """exp(angle K_z) within one ell."""
    m = np.arange(-ell, ell + 1)
    return np.diag(np.cos(m * angle)) + np.fliplr(np.diag(np.sin(m * angle)))


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
        """Return D(g) for the proper rotation matrix g that takes vectors n to g n."""
        first, tilt, last = euler_zyz(np.asarray(matrix))
        blocks = [
            _block_z(ell, first) @ _block_y(ell, tilt) @ _block_z(ell, last)
            for ell in range(lmax + 1)
        ]
        return cls(tuple(blocks))

    @property
    def T(self) -> Rotation:
        """The inverse rotation."""
        return Rotation(tuple(b.T for b in self.blocks))

    def __call__(self, modes: Float[Array, "*batch modes"]) -> Float[Array, "*batch modes"]:
        """Turn the field, or fields, with these coefficients."""
        xp = namespace(modes, self)
        if xp is np:
            turned = np.empty(modes.shape)
            for ell, block in enumerate(self.blocks):
                here = (..., slice(ell**2, (ell + 1) ** 2))
                turned[here] = modes[here] @ block.T
            return turned
        starts = (ell**2 for ell in range(len(self.blocks)))
        turned = [
            modes[..., i : i + len(block)] @ block.T
            for i, block in zip(starts, self.blocks, strict=True)
        ]
        return xp.concatenate(turned, axis=-1)


def euler_zyz(matrix: Float[np.ndarray, "3 3"]) -> tuple[float, float, float]:
    """Return the Euler angles of a rotation, in radians, exact also for a tilt of 0 or pi.

    Returns
    -------
    first, tilt, last : float
        With matrix = R_z(first) R_y(tilt) R_z(last).
    """
    tilt = np.arctan2(np.hypot(matrix[0, 2], matrix[1, 2]), matrix[2, 2])
    first = np.arctan2(matrix[1, 2], matrix[0, 2])
    # undo the first turn and the tilt: the last angle is that of the first column that remains
    sideways = np.array([-np.sin(first), np.cos(first), 0.0])
    along = np.array([np.cos(tilt) * np.cos(first), np.cos(tilt) * np.sin(first), -np.sin(tilt)])
    return first, tilt, np.arctan2(sideways @ matrix[:, 0], along @ matrix[:, 0])


def turn_about_z(
    modes: Float[Array, "*batch modes"], angle: float | Float[Array, ""]
) -> Float[Array, "*batch modes"]:
    """Turn fields about z.

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
    lmax = round(np.sqrt(modes.shape[-1])) - 1
    ell, m = mode_numbers(lmax)
    mirrored = modes[..., ell * (ell + 1) - m]
    xp = namespace(modes, angle)
    angles = m.astype(np.float64) * angle
    cosine, sine = xp.cos(angles), xp.sin(angles)
    shape = (1,) * (modes.ndim - 1) + (-1,)
    return modes * cosine.reshape(shape) + mirrored * sine.reshape(shape)


def turn_about_x(
    modes: Float[Array, "*batch modes"], angle: float | Float[Array, ""]
) -> Float[Array, "*batch modes"]:
    """Turn fields about x, from y towards z; else as :func:`turn_about_z`."""
    return _turn_about(0, modes, angle)


def turn_about_y(
    modes: Float[Array, "*batch modes"], angle: float | Float[Array, ""]
) -> Float[Array, "*batch modes"]:
    """Turn fields about y, from z towards x; else as :func:`turn_about_z`."""
    return _turn_about(1, modes, angle)


def _turn_about(axis: int, modes: Array, angle: Array | float) -> Array:
    from_axis = _z_from(axis, round(np.sqrt(modes.shape[-1])) - 1)
    return from_axis.T(turn_about_z(from_axis(modes), angle))


@lru_cache(maxsize=8)
def _z_from(axis: int, lmax: int) -> Rotation:
    """The rotation that takes the x axis (0) or the y axis (1) to z: a cyclic swap of the axes."""
    return Rotation.from_matrix(np.roll(np.eye(3), -(axis + 1), axis=1).T, lmax)


@lru_cache(maxsize=16)
def _horizontal_generators(lmax: int) -> tuple[np.ndarray, np.ndarray]:
    """K_x and K_y over all packed modes, as two columns and their weights for every row.

    A row (ell, m) has entries only in columns (ell, +-(|m| +- 1)), two of them non-zero.
    """
    columns = np.zeros((2, n_modes(lmax), 2), dtype=int)
    weights = np.zeros((2, n_modes(lmax), 2))
    for ell in range(lmax + 1):
        for axis, k in enumerate(generators(ell)[:2]):
            order = np.argsort(-np.abs(k), axis=1, kind="stable")[:, :2]
            rows = slice(ell**2, (ell + 1) ** 2)
            width = order.shape[1]
            columns[axis, rows, :width] = ell**2 + order
            weights[axis, rows, :width] = np.take_along_axis(k, order, axis=1)
    return columns, weights


def apply_generator(modes: Float[Array, "*batch modes"], axis: int) -> Float[Array, "*batch modes"]:
    """Return K_x (axis 0) or K_y (axis 1) times packed modes, in time linear in their number."""
    columns, weights = _horizontal_generators(round(np.sqrt(modes.shape[-1])) - 1)
    shape = (1,) * (modes.ndim - 1) + (-1,)
    first, second = (weights[axis, :, i].reshape(shape) for i in (0, 1))
    return first * modes[..., columns[axis, :, 0]] + second * modes[..., columns[axis, :, 1]]


def tilts(modes: Float[Array, "*batch modes"], order: int) -> list[Float[Array, "*batch modes"]]:
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
        right = apply_generator(terms[a, b - 1], 1) if b else 0.0
        terms[a, b] = left + right
    return list(terms.values())


def tilt_powers(order: int) -> list[tuple[int, int]]:
    """Return the powers (a, b) of (ex, ey) up to total degree ``order``, lowest degree first."""
    return [(n - b, b) for n in range(order + 1) for b in range(n + 1)]
