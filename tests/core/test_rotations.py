from math import factorial

import healpy
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import block_diag, expm
from scipy.spatial.transform import Rotation as SpatialRotation

from lusee_bayes.core import harmonics as r
from lusee_bayes.core.harmonics import from_healpy, n_modes, synthesis_matrix, to_healpy

LMAX = 10


def random_rotation(seed):
    return SpatialRotation.random(rng=np.random.default_rng(seed)).as_matrix()


def random_modes(seed, *batch, lmax=LMAX):
    return jnp.asarray(np.random.default_rng(seed).standard_normal((*batch, n_modes(lmax))))


def dense(rotation):
    return block_diag(*[np.asarray(b) for b in rotation.blocks])


def dense_generators(lmax):
    per_ell = [r.generators(ell) for ell in range(lmax + 1)]
    return [block_diag(*[k[axis] for k in per_ell]) for axis in range(3)]


def test_rotations_are_orthogonal():
    d = dense(r.Rotation.from_matrix(random_rotation(0), LMAX))
    np.testing.assert_allclose(d @ d.T, np.eye(n_modes(LMAX)), rtol=0, atol=1e-12)


def test_product_of_rotations():
    g, k = random_rotation(1), random_rotation(2)
    dg, dk, both = (r.Rotation.from_matrix(x, LMAX) for x in (g, k, g @ k))
    np.testing.assert_allclose(dense(dg) @ dense(dk), dense(both), rtol=0, atol=1e-12)


@pytest.mark.parametrize("seed", [3, 4, 5])
def test_a_turned_field_is_the_field_at_the_turned_back_direction(seed):
    g = random_rotation(seed)
    a = random_modes(seed)
    n = np.random.default_rng(seed).standard_normal((3, 50))
    n /= np.linalg.norm(n, axis=0)

    def field(modes, vectors):
        theta, phi = np.arccos(vectors[2]), np.arctan2(vectors[1], vectors[0])
        return synthesis_matrix(theta, phi, LMAX) @ np.asarray(modes)

    turned = field(r.Rotation.from_matrix(g, LMAX)(a), n)
    # arccos near a pole loses half the digits in theta, hence 1e-11 of fields of order ten
    np.testing.assert_allclose(turned, field(a, g.T @ n), rtol=0, atol=1e-11)


def test_agreement_with_healpy():
    psi, theta, phi = 0.3, 1.1, -2.0
    a = random_modes(6)
    alm = to_healpy(a)
    healpy.rotate_alm(alm, psi, theta, phi)  # about z by psi, y by theta, z by phi
    g = SpatialRotation.from_euler("ZYZ", [phi, theta, psi]).as_matrix()
    turned = r.Rotation.from_matrix(g, LMAX)(a)
    # healpy's recursion is good to about 1e-12
    np.testing.assert_allclose(turned, from_healpy(alm), rtol=0, atol=1e-11)


def test_inverse_identity_and_leading_axes():
    d = r.Rotation.from_matrix(random_rotation(7), LMAX)
    a = random_modes(7, 2, 3)
    np.testing.assert_allclose(d.T(d(a)), a, rtol=0, atol=1e-12)
    np.testing.assert_allclose(d(a)[1, 2], d(a[1, 2]), rtol=0, atol=1e-14)
    same = r.Rotation.from_matrix(np.eye(3), LMAX)(a)
    np.testing.assert_allclose(same, a, rtol=0, atol=1e-13)  # rounding of V V^H


@pytest.mark.parametrize("angle", [0.0, 0.4, -2.0, 40.0])
def test_turn_about_z(angle):
    a = random_modes(8, 2)
    exact = r.Rotation.from_matrix(SpatialRotation.from_euler("z", angle).as_matrix(), LMAX)
    np.testing.assert_allclose(r.turn_about_z(a, angle), exact(a), rtol=0, atol=1e-12)
    # ... by the closed form: a_lm picks up exp(-i m angle)
    _, m = healpy.Alm.getlm(LMAX)
    expected = from_healpy(to_healpy(a[0]) * np.exp(-1j * m * angle))
    np.testing.assert_allclose(r.turn_about_z(a, angle)[0], expected, rtol=0, atol=1e-12)


def test_turn_about_z_differentiates_to_its_generator():
    a = random_modes(9)
    _, slope = jax.jvp(lambda x: r.turn_about_z(a, x), (jnp.asarray(0.0),), (jnp.asarray(1.0),))
    np.testing.assert_allclose(slope, dense_generators(LMAX)[2] @ np.asarray(a), rtol=0, atol=1e-13)


def test_generators_are_an_angular_momentum():
    k_x, k_y, k_z = dense_generators(LMAX)
    for k in (k_x, k_y, k_z):
        np.testing.assert_allclose(k, -k.T, rtol=0, atol=1e-14)
    # entries up to ell^2 = 100: rounding 1e-14 of it
    np.testing.assert_allclose(k_x @ k_y - k_y @ k_x, k_z, rtol=0, atol=1e-12)
    np.testing.assert_allclose(k_y @ k_z - k_z @ k_y, k_x, rtol=0, atol=1e-12)
    ell = np.repeat(np.arange(LMAX + 1), 2 * np.arange(LMAX + 1) + 1)
    squared = k_x @ k_x + k_y @ k_y + k_z @ k_z
    np.testing.assert_allclose(squared, -np.diag(ell * (ell + 1.0)), rtol=0, atol=1e-12)


@pytest.mark.parametrize("axis", [0, 1])
def test_apply_generator_is_the_slope_of_the_rotation(axis):
    a, step = random_modes(10, 2), 1e-4
    vector = np.eye(3)[axis] * step
    ahead, behind = (
        r.Rotation.from_matrix(SpatialRotation.from_rotvec(v).as_matrix(), LMAX)(a)
        for v in (vector, -vector)
    )
    slope = (np.asarray(ahead) - np.asarray(behind)) / (2 * step)
    # central difference: (lmax step)^2 lmax / 6 = 2e-6 of a mode
    np.testing.assert_allclose(r.apply_generator(a, axis), slope, rtol=0, atol=2e-5)
    exact = np.asarray(a) @ dense_generators(LMAX)[axis].T
    np.testing.assert_allclose(r.apply_generator(a, axis), exact, rtol=0, atol=1e-12)


@pytest.mark.parametrize("lmax", [0, 1])
def test_the_lowest_lmax(lmax):
    a = random_modes(11, lmax=lmax)
    for axis in (0, 1):
        exact = dense_generators(lmax)[axis] @ np.asarray(a)
        np.testing.assert_allclose(r.apply_generator(a, axis), exact, rtol=0, atol=1e-15)
    np.testing.assert_allclose(r.turn_about_z(a, 0.0), a, rtol=0, atol=0)


def test_powers_count_the_monomials():
    assert r.tilt_powers(2) == [(0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2)]


@pytest.mark.parametrize("order", [0, 1, 2, 3, 4])
def test_the_tilt_series_converges_at_its_order(order):
    ex, ey = 3e-3, -4e-3
    k_x, k_y, _ = dense_generators(LMAX)
    a = random_modes(12)
    exact = expm(ex * k_x + ey * k_y) @ np.asarray(a)
    terms = r.tilts(a, order)
    series = sum(
        ex**p * ey**q / factorial(p + q) * np.asarray(w)
        for (p, q), w in zip(r.tilt_powers(order), terms, strict=True)
    )
    error = np.linalg.norm(series - exact) / np.linalg.norm(a)
    # Taylor remainder with |ex K_x + ey K_y| <= lmax |e| = 0.05; and not much smaller either,
    # since a random field has most of its modes near lmax
    bound = (LMAX * 5e-3) ** (order + 1) / factorial(order + 1)
    assert 0.02 * bound < error < bound
