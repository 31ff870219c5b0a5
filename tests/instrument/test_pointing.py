from math import factorial

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import block_diag, expm
from scipy.spatial.transform import Rotation as SpatialRotation

import lusee_bayes as lb
from lusee_bayes.core.rotations import generators, tilt_powers
from lusee_bayes.instrument.pointing import (
    LEAST_ORDER,
    TILT_TOLERANCE,
    Pointing,
    mean_pole_frame,
    split,
    sufficient_order,
)


def rebuilt(azimuth, tilt):
    """exp(ex K_x + ey K_y) exp(phi K_z), by scipy."""
    vectors = np.column_stack([tilt, np.zeros(len(tilt))])
    tilts = SpatialRotation.from_rotvec(vectors).as_matrix()
    turns = np.column_stack([np.zeros((len(tilt), 2)), azimuth])
    return tilts @ SpatialRotation.from_rotvec(turns).as_matrix()


def test_split_reproduces_any_rotation():
    rotations = SpatialRotation.random(200, rng=np.random.default_rng(0)).as_matrix()
    # large tilts, up to 180 degrees: nothing is expanded here
    np.testing.assert_allclose(rebuilt(*split(rotations)), rotations, rtol=0, atol=1e-12)


def test_split_of_a_turn_about_z_has_no_tilt():
    angles = np.array([-3.0, 0.0, 0.5, 3.1])
    azimuth, tilt = split(rebuilt(angles, np.zeros((4, 2))))
    np.testing.assert_allclose(azimuth, angles, rtol=0, atol=1e-15)
    np.testing.assert_array_equal(tilt, 0.0)


def test_split_reproduces_the_moon():
    moon = lb.Observation.from_runs([lb.Run(1.0)]).mcmf_from_galactic()
    frame = mean_pole_frame(moon)
    # lunarsky's matrices are orthogonal to 1e-15; the sample times add nothing
    np.testing.assert_allclose(rebuilt(*split(moon @ frame.T)) @ frame, moon, rtol=0, atol=1e-12)
    np.testing.assert_allclose(frame @ frame.T, np.eye(3), rtol=0, atol=1e-14)
    assert np.linalg.det(frame) == pytest.approx(1.0, abs=1e-14)


@pytest.mark.parametrize(("cycles", "wander"), [(1, 0.044), (3, 0.083)])
def test_the_axis_wanders_as_far_as_the_moons_pole_does(cycles, wander):
    o = lb.Observation.from_runs([lb.Run(1.0)] * cycles)
    pole = o.mcmf_from_galactic()[:, 2]  # the Moon's z axis in Galactic coordinates
    mean = pole.mean(axis=0)
    angle = np.degrees(np.arctan2(np.linalg.norm(np.cross(pole, mean), axis=1), pole @ mean))
    assert angle.max() == pytest.approx(wander, abs=5e-4)  # DESIGN section 5, to its digits
    moon = o.mcmf_from_galactic()
    _, tilt = split(moon @ mean_pole_frame(moon).T)
    np.testing.assert_allclose(np.degrees(np.hypot(*tilt.T)), angle, rtol=0, atol=1e-9)


@pytest.mark.parametrize("lmax", [4, 12])
@pytest.mark.parametrize("size", [0.0, 1e-7, 1e-4, 1e-3, 1e-2])
def test_sufficient_order_is_the_lowest_that_bounds_the_series(size, lmax):
    tilt = np.array([[0.6 * size, -0.8 * size], [0.0, 0.0]])
    order = sufficient_order(tilt, lmax)
    # the error of the truncated series at the highest ell, by matrix exponentials
    k_x, k_y, _ = generators(lmax)
    generator = tilt[0, 0] * k_x + tilt[0, 1] * k_y
    exact = expm(generator)

    def error(n):
        series = sum(np.linalg.matrix_power(generator, i) / factorial(i) for i in range(n + 1))
        return np.linalg.norm(series - exact, 2)

    assert error(order) <= TILT_TOLERANCE
    if order > LEAST_ORDER:
        # the highest eigenvalue of the generator is i lmax |tilt|: the bound is reached
        assert error(order - 1) > 0.9 * TILT_TOLERANCE


def test_a_negative_order_is_refused():
    with pytest.raises(
        lb.InputError, match="order of the tilt expansion must be 0, 1, ..., got -1"
    ):
        Pointing.of(lb.Observation.from_runs([lb.Run(0.1)]), 3, order=-1)


def test_runs_and_fixed_rotations():
    o = lb.Observation.from_runs([lb.Run(0.1, 0.0), lb.Run(0.2, 90.0)])
    p = Pointing.of(o, 3, order=1)
    assert p.n_times == o.n_times
    assert p.order == 1
    for number, span in p.runs():
        np.testing.assert_array_equal(o.run[span], number)
    np.testing.assert_allclose(p.turntable, [0.0, np.pi / 2])
    # a dipole towards the zenith becomes one towards the site's direction in the Moon's frame
    zenith = jnp.asarray([0.0, 0.0, 1.0, 0.0] + 12 * [0.0])
    lon, lat = np.radians([o.lon_deg, o.lat_deg])
    up = [np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)]
    # packed dipole: (y, z, -x)
    got = p.mcmf_from_lander(zenith)[1:4]
    np.testing.assert_allclose(got, [up[1], up[2], -up[0]], rtol=0, atol=1e-14)


def test_functions_and_factors_expand_the_transposed_tilt(monkeypatch):
    monkeypatch.setattr("lusee_bayes.instrument.window_average.TOLERANCE", 1e-15)
    lmax, order = 3, 6
    o = lb.Observation.from_runs([lb.Run(0.05)])
    p = Pointing.of(o, lmax, order=order)
    # instants: every order m alike, and nothing imaginary
    factors = np.asarray(p.factors)
    np.testing.assert_allclose(factors[..., 1], 0.0, atol=1e-15)
    series_of = np.asarray(p.functions) @ factors[:, :, 0, 0]
    k_x, k_y = (block_diag(*[generators(ell)[i] for ell in range(lmax + 1)]) for i in (0, 1))
    words = {(0, 0): np.eye(16)}
    for a, b in tilt_powers(order)[1:]:  # the sum over all orders of a K_x and b K_y
        words[a, b] = (words[a - 1, b] @ k_x if a else 0) + (words[a, b - 1] @ k_y if b else 0)
    moon = o.mcmf_from_galactic()
    azimuth, tilts = split(moon @ mean_pole_frame(moon).T)
    np.testing.assert_allclose(p.azimuth, azimuth, rtol=0, atol=1e-15)
    for t in range(p.n_times):
        series = sum(f * w for f, w in zip(series_of[t], words.values(), strict=True))
        ex, ey = tilts[t]
        # (lmax |tilt|)^7 / 7! is zero to rounding
        np.testing.assert_allclose(series, expm(ex * k_x + ey * k_y).T, rtol=0, atol=3e-14)
