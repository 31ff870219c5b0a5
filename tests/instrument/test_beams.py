"""Grid, fields and product beams against closed forms and brute force."""

import numpy as np
import pytest
from assertions import close, refuse, within
from reference import hemisphere, real_harmonics, tangents, unit_vectors

from lusee_bayes.core.harmonics import mode_numbers, n_modes, polar_functions, synthesis_matrix
from lusee_bayes.instrument.beams import fields as bf
from lusee_bayes.instrument.beams.luseepy_files import BandLimitedGrid, ScalarBeam
from lusee_bayes.instrument.products import auto_indices, to_real

LMAX = 16
GRID = bf.HemisphereGrid.for_lmax(LMAX)


def short_dipole(axis):
    """Field of a short dipole along a unit vector, in free space above the horizon."""
    towards = tangents(GRID.theta[:, None], GRID.phi)
    return bf.AntennaFields(*((along @ axis)[None] + 0j for along in towards), GRID)


def random_fields(seed, n_antennas, grid):
    """Smooth fields: polynomials of degree two in the components of n with random weights."""
    rng = np.random.default_rng(seed)
    x, y, z = unit_vectors(grid)
    basis = np.stack([np.ones_like(x), x, y, z, x * y, z * z, x * x - y * y])

    def one():
        weights = rng.standard_normal((2, n_antennas, len(basis)))
        return np.asarray(np.einsum("ab,btp->atp", weights[0] + 1j * weights[1], basis))

    return bf.AntennaFields(one(), one(), grid)


def test_only_the_sky_above_the_horizon_answers():
    modes = bf.product_modes(random_fields(0, 2, GRID), LMAX, normalise=False)
    sky = np.random.default_rng(1).standard_normal(n_modes(LMAX))
    theta, phi = (a.ravel() for a in np.meshgrid(GRID.theta, GRID.phi, indexing="ij"))
    above = (synthesis_matrix(theta, phi, LMAX) @ sky).reshape(len(GRID.theta), -1)
    patterns = to_real(bf.stokes_beam(random_fields(0, 2, GRID)))
    expected = GRID.integrate(patterns * np.asarray(above)[None])
    within(np.asarray(modes) @ sky, expected, 1e-12 * np.abs(expected).max())
    # and by an independent rule with scipy's harmonics, above the horizon alone
    theta, phi, solid_angle = hemisphere(40, 90)
    one = bf.product_modes(short_dipole([0, 0, 1]), 4, normalise=False)[0]
    there = real_harmonics(theta, phi, 4) @ sky[:25]
    brute = np.sum(solid_angle * np.sin(theta) ** 2 / 2 * there)
    np.testing.assert_allclose(np.asarray(one) @ sky[:25], brute, rtol=1e-12)


def test_a_fully_polarised_wave_gives_the_product_of_the_voltages():
    fields, rng = random_fields(2, 3, GRID), np.random.default_rng(3)
    for _ in range(5):
        e = rng.standard_normal(2) + 1j * rng.standard_normal(2)
        coherency = np.outer(e, e.conj())  # [[I + Q, U - i V], [U + i V, I - Q]] / 2
        stokes = {
            "I": np.trace(coherency).real,
            "Q": (coherency[0, 0] - coherency[1, 1]).real,
            "U": 2 * coherency[0, 1].real,
            "V": -2 * coherency[0, 1].imag,
        }
        got = sum(np.asarray(bf.stokes_beam(fields, s)) * value for s, value in stokes.items())
        voltage = np.asarray(fields.e_theta) * e[0] + np.asarray(fields.e_phi) * e[1]
        close(got, voltage[:, None] * voltage[None].conj(), 1e-13)


def test_normalised_autos_average_to_one():
    fields = random_fields(7, 3, GRID)
    uniform = np.sqrt(4 * np.pi)  # the monopole coefficient of a sky of 1 K
    raw = bf.product_modes(fields, 4, normalise=False)
    scaled, autos = bf.product_modes(fields, 4), auto_indices(3)
    mean = np.mean(np.asarray(raw)[autos, 0]) * uniform
    np.testing.assert_allclose(mean, bf.mean_auto_integral(fields), rtol=1e-13)
    assert np.mean(np.asarray(scaled)[autos, 0]) * uniform == pytest.approx(1.0, rel=1e-13)
    np.testing.assert_allclose(scaled, np.asarray(raw) / mean, rtol=1e-12)
    # Q is scaled by the same Stokes I integral, which keeps |Q| <= I
    q = bf.product_modes(fields, 4, stokes="Q")
    q_raw = bf.product_modes(fields, 4, stokes="Q", normalise=False)
    np.testing.assert_allclose(q, np.asarray(q_raw) / mean, rtol=1e-12)


def test_modes_keep_leading_axes():
    patterns = to_real(bf.stokes_beam(random_fields(9, 2, GRID)))
    both = GRID.modes(patterns.reshape(2, 2, *patterns.shape[1:]), 4)
    within(both[1, 0], GRID.modes(patterns[2], 4), 1e-14)


def test_what_no_beams_are_is_refused():
    coarse = bf.HemisphereGrid.gauss_legendre(10, 8)
    refuse("8 azimuths.*lmax = 4", coarse.modes, np.ones((10, 8)), 4)
    good = short_dipole([0, 0, 1])
    refuse("e_theta must be", bf.AntennaFields, good.e_theta.astype(np.complex64), good.e_phi, GRID)
    refuse("e_theta has shape", bf.AntennaFields, good.e_theta[:, 1:], good.e_phi[:, 1:], GRID)
    refuse("Stokes.*'W'.*I, Q, U, V", bf.stokes_beam, good, "W")
    refuse("3 products do not match", bf.ProductBeams, np.zeros((3, 4)), 10.0)
    refuse("5 coefficients.*lmax", bf.ProductBeams, np.zeros((4, 5)), 10.0)


# --- luseepy's quadrature rules, against closed forms ---------------------------------------------


def test_a_band_limited_pattern_above_the_horizon_is_integrated_as_it_is_given():
    """A sum of harmonics that vanishes below the horizon does not exist; but what the rule makes of
    samples is linear, so the sum over both hemispheres of a function gives its coefficients back.

    Samples below the horizon are those of the mirrored function, of (-1)^(ell + m) the harmonics.
    """
    lmax, n = 6, 9
    theta = np.linspace(0.0, np.pi / 2, n)
    grid = BandLimitedGrid.of(theta, 16)
    weights = grid.polar_weights(lmax)
    ell, m = mode_numbers(lmax)
    polar, mirror = polar_functions(theta, lmax), (-1.0) ** (ell + m)
    # coefficients of lambda_lm of given m over the whole sphere: (1 + mirror mirror') of the half
    for k in range(len(ell)):
        same = m == m[k]
        both = weights[:, same].T @ polar[:, k] * (1.0 + mirror[same] * mirror[k])
        within(both, (ell[same] == ell[k]) / (2 * np.pi), 1e-13)
    # and the integral over the whole sphere of 1 is 4 pi: two halves
    assert float(grid.integrate(np.ones((1, n, 16)))[0]) == pytest.approx(2 * np.pi, rel=1e-13)


def test_the_rectangle_rule():
    """sin(theta) dtheta over [0, pi / 2] by hand: the sum falls short by a twelfth of the step
    squared (Euler and Maclaurin) on top of half the last ring."""
    n = 91
    fields = np.ones((1, n, 180), dtype=complex)
    beam = ScalarBeam("", np.ones(1), np.linspace(0.0, np.pi / 2, n), fields, fields, np.ones(1))
    grid, step = beam.luseepy_grid(), np.pi / 180
    found, expected = grid.integrate(np.ones((1, n, 180))), 1.0 + step / 2 - step**2 / 12
    assert float(found[0]) == pytest.approx(2 * np.pi * expected, rel=1e-9)
