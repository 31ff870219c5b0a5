"""Real harmonics, and their rotations: against scipy, healpy, and the laws that they obey."""

from math import factorial

import healpy
import jax.numpy as jnp
import numpy as np
import pytest
from assertions import refuse, within
from astropy import units as u
from reference import real_harmonics, sphere
from scipy.linalg import block_diag, expm
from scipy.spatial.transform import Rotation as SpatialRotation

from lusee_bayes.core import harmonics as h
from lusee_bayes.core.harmonics import from_healpy, n_modes, synthesis_matrix, to_healpy
from lusee_bayes.core.sphere_grid import SphereGrid
from lusee_bayes.instrument.products import ports

LMAX = 9


def random_alm(rng, lmax, *batch):
    """Complex coefficients of a real field in healpy's packing."""
    n = healpy.Alm.getsize(lmax)
    alm = rng.standard_normal((*batch, n)) + 1j * rng.standard_normal((*batch, n))
    alm[..., : lmax + 1] = alm[..., : lmax + 1].real  # m = 0 comes first
    return alm


def test_packing_is_ell_squared_plus_ell_plus_m():
    ell, m = h.mode_numbers(LMAX)
    pairs = [(le, mm) for le in range(LMAX + 1) for mm in range(-le, le + 1)]
    assert pairs == list(zip(ell, m, strict=True))
    np.testing.assert_array_equal(ell**2 + ell + m, np.arange(h.n_modes(LMAX)))
    assert [h.lmax_of(h.n_modes(lmax)) for lmax in (0, 1, 47)] == [0, 1, 47]


@pytest.mark.parametrize("n", [0, 2, 3, 2303])
def test_a_number_that_is_no_square_is_refused(n):
    refuse(f"{n} coefficients", h.lmax_of, n)


@pytest.mark.parametrize("batch", [(), (3,), (2, 3)])
def test_coefficients_are_the_parts_of_healpys(batch):
    alm = random_alm(np.random.default_rng(0), LMAX, *batch)
    modes, (ell, m) = h.from_healpy(alm), h.mode_numbers(LMAX)
    a = alm[..., healpy.Alm.getidx(LMAX, ell, np.abs(m))]
    expected = np.where(m < 0, a.imag, a.real) * np.where(m == 0, 1.0, np.sqrt(2))
    np.testing.assert_allclose(modes, expected, rtol=1e-15)
    for index in np.ndindex(batch):
        np.testing.assert_allclose(h.to_healpy(jnp.asarray(modes[index])), alm[index], rtol=1e-15)


def test_synthesis_agrees_with_scipy_and_healpy():
    rng = np.random.default_rng(2)
    alm = random_alm(rng, LMAX)
    modes = h.from_healpy(alm)
    theta, phi = np.arccos(rng.uniform(-1, 1, 60)), rng.uniform(-4, 8, 60)
    # recursions over ell <= 9 lose a few bits
    within(h.synthesis_matrix(theta, phi, LMAX), real_harmonics(theta, phi, LMAX), 1e-13)
    field = healpy.alm2map(alm, 8, lmax=LMAX)
    # healpy's transforms are good to 1e-13 of the field
    atol = 1e-12 * np.abs(field).max()
    within(h.pixel_matrix(8, LMAX) @ modes, field, atol)
    within(h.modes_to_map(jnp.asarray(modes), 8), field, atol)


def test_a_map_gives_back_its_coefficients():
    alm = random_alm(np.random.default_rng(4), LMAX)
    # ten Jacobi iterations of healpy's quadrature (error 1e-3 each at this ell) reach rounding
    within(h.map_to_modes(healpy.alm2map(alm, 16, lmax=LMAX), LMAX), h.from_healpy(alm), 1e-11)


def test_spectrum_is_healpys():
    alm = random_alm(np.random.default_rng(6), LMAX, 2)
    modes = jnp.asarray(h.from_healpy(alm))
    expected = np.stack([healpy.alm2cl(a) for a in alm])
    np.testing.assert_allclose(h.power_spectrum(modes), expected, rtol=1e-14)
    by_loop = [np.sum(np.asarray(modes)[:, e**2 : (e + 1) ** 2], axis=1) for e in range(LMAX + 1)]
    np.testing.assert_allclose(h.sum_over_m(modes), np.stack(by_loop, axis=1), rtol=1e-13)
    np.testing.assert_array_equal(h.per_mode(jnp.arange(LMAX + 1.0)), h.mode_numbers(LMAX)[0])


def test_bad_maps_are_refused():
    refuse("100 pixels.*HEALPix map", h.map_to_modes, np.ones(100), 2)
    refuse(r"1 of 48.*\(5,\)", h.map_to_modes, np.where(np.arange(48) == 5, np.nan, 1.0), 2)
    refuse("supports lmax <= 5", h.map_to_modes, np.ones(48), 6)
    refuse("UNSEEN", h.map_to_modes, np.where(np.arange(48) == 5, healpy.UNSEEN, 1.0), 2)
    refuse("has a unit", h.map_to_modes, np.ones(48) << u.mK, 2)
    refuse("has a mask", h.map_to_modes, np.ma.array(np.ones(48), mask=np.arange(48) == 5), 2)


def test_arrays_that_all_share_cannot_be_changed():
    shared = *h.mode_numbers(3), *ports(), *h.generators(2), h.modes_by_size_of_order(3)
    for one in (*shared, h.polar_functions(np.array([0.3]), 3)):
        with pytest.raises(ValueError, match="read-only"):
            one[...] = 0
    refuse("the field has shape", SphereGrid.of(3, 6).product_matrix, np.ones((3, 4)))


HIGHEST, LMAX, OF_FIELD = 7, 4, 3


def field(theta, phi):
    """A field of degree 3."""
    coefficients = np.random.default_rng(1).normal(size=n_modes(OF_FIELD))
    return synthesis_matrix(theta, phi, OF_FIELD) @ coefficients


@pytest.mark.parametrize("lmax", [LMAX, HIGHEST])
def test_a_product_matrix_is_an_integral(lmax):
    grid = SphereGrid.of(HIGHEST, HIGHEST + OF_FIELD)
    found = grid.product_matrix(field(*grid.directions()).reshape(grid.shape), lmax)
    # another rule: equal steps in azimuth from elsewhere, and many more rings
    theta, phi, area = sphere(40, 50)
    y = synthesis_matrix(theta, phi, HIGHEST)
    expected = (y * (area * field(theta, phi))[:, None]).T @ y
    np.testing.assert_allclose(found, expected[: n_modes(lmax)], atol=1e-13)


TURNED = 10


def random_rotation(seed):
    return SpatialRotation.random(rng=np.random.default_rng(seed)).as_matrix()


def random_modes(seed, *batch, lmax=TURNED):
    return jnp.asarray(np.random.default_rng(seed).standard_normal((*batch, n_modes(lmax))))


def dense_generators(lmax):
    per_ell = [h.generators(ell) for ell in range(lmax + 1)]
    return [block_diag(*[k[axis] for k in per_ell]) for axis in range(3)]


@pytest.mark.parametrize("seed", [3, 4, 5])
def test_a_turned_field_is_the_field_at_the_turned_back_direction(seed):
    g, a = random_rotation(seed), random_modes(seed)
    n = np.random.default_rng(seed).standard_normal((3, 50))
    n /= np.linalg.norm(n, axis=0)

    def field(modes, vectors):
        theta, phi = np.arccos(vectors[2]), np.arctan2(vectors[1], vectors[0])
        return synthesis_matrix(theta, phi, TURNED) @ np.asarray(modes)

    # arccos near a pole loses half the digits in theta, hence 1e-11 of fields of order ten
    within(field(h.Rotation.from_matrix(g, TURNED)(a), n), field(a, g.T @ n), 1e-11)


def test_agreement_with_healpy():
    psi, theta, phi = 0.3, 1.1, -2.0
    a = random_modes(6)
    alm = to_healpy(a)
    healpy.rotate_alm(alm, psi, theta, phi)  # about z by psi, y by theta, z by phi
    g = SpatialRotation.from_euler("ZYZ", [phi, theta, psi]).as_matrix()
    # healpy's recursion is good to about 1e-12
    within(h.Rotation.from_matrix(g, TURNED)(a), from_healpy(alm), 1e-11)


def test_inverse_identity_and_leading_axes():
    d, a = h.Rotation.from_matrix(random_rotation(7), TURNED), random_modes(7, 2, 3)
    within(d.T(d(a)), a, 1e-12)
    within(d(a)[1, 2], d(a[1, 2]), 1e-14)
    within(h.Rotation.from_matrix(np.eye(3), TURNED)(a), a, 1e-13)  # rounding of V V^H


@pytest.mark.parametrize("angle", [0.0, 0.4, -2.0, 40.0])
def test_turn_about_z(angle):
    a = random_modes(8, 2)
    exact = h.Rotation.from_matrix(SpatialRotation.from_euler("z", angle).as_matrix(), TURNED)
    within(h.turn_about_z(a, angle), exact(a), 1e-12)
    # ... by the closed form: a_lm picks up exp(-i m angle)
    _, m = healpy.Alm.getlm(TURNED)
    expected = from_healpy(to_healpy(a[0]) * np.exp(-1j * m * angle))
    within(h.turn_about_z(a, angle)[0], expected, 1e-12)


def test_generators_are_an_angular_momentum():
    k_x, k_y, k_z = dense_generators(TURNED)
    for k in (k_x, k_y, k_z):
        within(k, -k.T, 1e-14)
    # entries up to ell^2 = 100: rounding 1e-14 of it
    within(k_x @ k_y - k_y @ k_x, k_z, 1e-12)
    within(k_y @ k_z - k_z @ k_y, k_x, 1e-12)
    ell = np.repeat(np.arange(TURNED + 1), 2 * np.arange(TURNED + 1) + 1)
    within(k_x @ k_x + k_y @ k_y + k_z @ k_z, -np.diag(ell * (ell + 1.0)), 1e-12)


@pytest.mark.parametrize("axis", [0, 1])
def test_apply_generator_is_the_slope_of_the_rotation(axis):
    a, step = random_modes(10, 2), 1e-4
    vector = np.eye(3)[axis] * step
    ahead, behind = (
        h.Rotation.from_matrix(SpatialRotation.from_rotvec(v).as_matrix(), TURNED)(a)
        for v in (vector, -vector)
    )
    # central difference: (lmax step)^2 lmax / 6 = 2e-6 of a mode
    within(h.apply_generator(a, axis), (np.asarray(ahead) - np.asarray(behind)) / (2 * step), 2e-5)
    within(h.apply_generator(a, axis), np.asarray(a) @ dense_generators(TURNED)[axis].T, 1e-12)


@pytest.mark.parametrize("lmax", [0, 1])
def test_the_lowest_lmax(lmax):
    a = random_modes(11, lmax=lmax)
    for axis in (0, 1):
        within(h.apply_generator(a, axis), dense_generators(lmax)[axis] @ np.asarray(a), 1e-15)
    within(h.turn_about_z(a, 0.0), a, 0)


@pytest.mark.parametrize("order", [0, 1, 2, 3, 4])
def test_the_tilt_series_converges_at_its_order(order):
    ex, ey = 3e-3, -4e-3
    k_x, k_y, _ = dense_generators(TURNED)
    a = random_modes(12)
    exact = expm(ex * k_x + ey * k_y) @ np.asarray(a)
    series = sum(
        ex**p * ey**q / factorial(p + q) * np.asarray(w)
        for (p, q), w in zip(h.tilt_powers(order), h.tilts(a, order), strict=True)
    )
    error = np.linalg.norm(series - exact) / np.linalg.norm(a)
    # Taylor remainder with |ex K_x + ey K_y| <= lmax |e| = 0.05; and not much smaller either,
    # since a random field has most of its modes near lmax
    bound = (TURNED * 5e-3) ** (order + 1) / factorial(order + 1)
    assert 0.02 * bound < error < bound
