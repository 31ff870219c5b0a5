"""The naive oracle against closed forms: what tests others is tested first."""

import astropy.units as u
import numpy as np
import pytest
import reference as ref
from assertions import within
from astropy.coordinates import ICRS, CartesianRepresentation, Galactic
from astropy.time import Time
from lunarsky import MCMF

SITE = {"lon_deg": 182.258, "lat_deg": -23.814}
WHEN = Time("2027-01-20T03:00:00")


def test_real_harmonics_are_the_textbook_ones():
    theta, phi = np.array([0.4, 1.7, 3.0]), np.array([0.2, 2.5, 5.5])
    x, y, z = np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)
    got = ref.real_harmonics(theta, phi, 2)
    one, two = np.sqrt(3 / (4 * np.pi)), np.sqrt(15 / (4 * np.pi))
    expected = [
        np.full(3, 1 / np.sqrt(4 * np.pi)),
        *(one * y, one * z, -one * x),  # Condon-Shortley signs of odd m
        *(-two * x * y, two * y * z, two * (3 * z**2 - 1) / np.sqrt(12), -two * x * z),
        two * (x**2 - y**2) / 2,
    ]
    np.testing.assert_allclose(got, np.stack(expected, axis=1), rtol=0, atol=1e-15)


def test_the_hemisphere_integrates_polynomials():
    theta, phi, solid_angle = ref.hemisphere(6, 12)
    z, x = np.cos(theta), np.sin(theta) * np.cos(phi)
    np.testing.assert_allclose(solid_angle.sum(), 2 * np.pi, rtol=1e-14)
    np.testing.assert_allclose(np.sum(solid_angle * z), np.pi, rtol=1e-14)
    np.testing.assert_allclose(np.sum(solid_angle * x**2), 2 * np.pi / 3, rtol=1e-14)
    assert theta.max() < np.pi / 2


def test_directions_in_the_galaxy():
    # the zenith is the site's direction in MCMF; a quarter turn of azimuth from North is East
    theta, phi = np.array([0.0, np.pi / 2, np.pi / 2]), np.array([0.0, 0.0, np.pi / 2])
    colatitude, longitude = ref.galactic_directions(theta, phi, WHEN, **SITE)
    galactic = Galactic(l=longitude * u.rad, b=(np.pi / 2 - colatitude) * u.rad)
    vectors = galactic.transform_to(ICRS()).cartesian.xyz.value
    turned = ICRS(CartesianRepresentation(vectors)).transform_to(MCMF(obstime=WHEN))
    up, east, north = turned.cartesian.xyz.value.T
    lon, lat = np.radians([SITE["lon_deg"], SITE["lat_deg"]])
    at = [np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)]
    np.testing.assert_allclose(up, at, rtol=0, atol=1e-10)
    np.testing.assert_allclose(east, [-np.sin(lon), np.cos(lon), 0.0], rtol=0, atol=1e-10)
    assert north[2] == pytest.approx(np.cos(lat), abs=1e-10)


def test_a_uniform_sky_through_a_cosine_beam():
    grid, sky = ref.hemisphere(8, 16), np.array([5.0 * np.sqrt(4 * np.pi), 0.0, 0.0, 0.0])
    got = ref.visibilities(np.cos(grid[0])[None] / np.pi, grid, sky, WHEN, **SITE)
    np.testing.assert_allclose(got, [5.0], rtol=1e-13)


def test_turning_the_antennas_turns_the_response():
    # a response towards the East (x), turned by a quarter, is one towards the North (y)
    theta, phi, _ = grid = ref.hemisphere(8, 16)
    x, y = np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi)
    sky = np.random.default_rng(0).standard_normal(9)
    turned = ref.visibilities(x[None], grid, sky, WHEN, **SITE, turntable_deg=90.0)
    straight = ref.visibilities(y[None], grid, sky, WHEN, **SITE)
    np.testing.assert_allclose(turned, straight, rtol=1e-10)


def test_one_slab_is_airys_formula():
    eps, end, thickness, cosine, frequency = 3.0 - 0.1j, 5.0 - 0.02j, 4.0, 0.6, 20.0
    k = 2e6 * np.pi * frequency / ref.SPEED_OF_LIGHT
    q = [cosine, np.sqrt(eps - 1 + cosine**2), np.sqrt(end - 1 + cosine**2)]
    for got, y in zip(
        ref.layered_reflection([eps, end], thickness, cosine, frequency),
        (q, [q[0], q[1] / eps, q[2] / end]),
        strict=True,
    ):
        r01, r12 = ((y[i] - y[i + 1]) / (y[i] + y[i + 1]) for i in (0, 1))
        delay = np.exp(-2j * k * q[1] * thickness)
        within(got, (r01 + r12 * delay) / (1 + r01 * r12 * delay), 1e-14)


def test_the_current_integral_in_free_space():
    # int_0^L sin k(L - s) exp(i k s c) ds = (exp(i k L c) - cos k L - i c sin k L) / k (1 - c^2)
    frequency, length, theta = 40.0, 3.0, 0.8
    k = 2e6 * np.pi * frequency / ref.SPEED_OF_LIGHT
    c, kl = np.cos(theta), k * length
    expected = (np.exp(1j * kl * c) - np.cos(kl) - 1j * c * np.sin(kl)) / (k * (1 - c**2))
    up = np.array([0.0, 0.0, 1.0])
    e_theta, e_phi = ref.arm_response(theta, 1.0, frequency_mhz=frequency, length=length, arm=up)
    # Simpson's rule with 4000 steps: (k h)^4 = 1e-11
    np.testing.assert_allclose(e_theta, -np.sin(theta) * expected, rtol=1e-11)
    assert abs(e_phi) < 1e-15


def test_a_conducting_ground_doubles_vertical_and_cancels_horizontal_currents():
    options = {"frequency_mhz": 5.0, "length": 0.01, "reflection": (-1.0, 1.0), "height": 0.0}
    up, east = np.array([0.0, 0.0, 1.0]), np.array([1.0, 0.0, 0.0])
    free = ref.arm_response(1.0, 0.5, frequency_mhz=5.0, length=0.01, arm=up)
    grounded = ref.arm_response(1.0, 0.5, arm=up, **options)
    # the arm is 2e-4 wavelengths: its phase changes the sum at that order squared
    np.testing.assert_allclose(grounded[0], 2 * free[0], rtol=1e-3)
    assert np.abs(ref.arm_response(1.0, 0.5, arm=east, **options)).max() < 1e-12 * abs(free[0])
