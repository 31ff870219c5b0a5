"""The pointing, and offsets of it that are shifted exactly and inside compiled functions."""

from __future__ import annotations

from dataclasses import replace
from math import factorial

import astropy.units as u
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from assertions import refuse, refused
from reference import steep_sky
from scipy.linalg import block_diag, expm
from scipy.spatial.transform import Rotation as SpatialRotation

import lusee_bayes as lb
from lusee_bayes.core.harmonics import Rotation, generators, tilt_powers, turn_about
from lusee_bayes.instrument.pointing import (
    LEAST_ORDER,
    OFFSETS,
    TILT_TOLERANCE,
    Pointing,
    mean_pole_frame,
    offset_names,
    split,
    sufficient_order,
    turned_by_offsets,
    with_offsets,
)
from lusee_bayes.instrument.products import DataLayout
from lusee_bayes.noise.radiometer import paper_variance


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


@pytest.mark.parametrize(("cycles", "wander"), [(1, 0.044), (3, 0.083)])
def test_the_axis_wanders_as_far_as_the_moons_pole_does(cycles, wander):
    o = lb.Observation.from_runs([lb.Run(1.0)] * cycles)
    pole = o.mcmf_from_galactic[:, 2]  # the Moon's z axis in Galactic coordinates
    mean = pole.mean(axis=0)
    angle = np.degrees(np.arctan2(np.linalg.norm(np.cross(pole, mean), axis=1), pole @ mean))
    assert angle.max() == pytest.approx(wander, abs=5e-4)  # DESIGN section 5, to its digits
    moon = o.mcmf_from_galactic
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
    with refused("order of the tilt expansion must be 0, 1, ..., got -1"):
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
    monkeypatch.setattr("lusee_bayes.instrument.averaging.TOLERANCE", 1e-15)
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
    moon = o.mcmf_from_galactic
    azimuth, tilts = split(moon @ mean_pole_frame(moon).T)
    np.testing.assert_allclose(p.azimuth, azimuth, rtol=0, atol=1e-15)
    for t in range(p.n_times):
        series = sum(f * w for f, w in zip(series_of[t], words.values(), strict=True))
        ex, ey = tilts[t]
        # (lmax |tilt|)^7 / 7! is zero to rounding
        np.testing.assert_allclose(series, expm(ex * k_x + ey * k_y).T, rtol=0, atol=3e-14)


# --- offsets of clock and pointing ----------------------------------------------------------------


LMAX = 12
VALUES = {
    "clock_s": 60.0,
    "clock_drift_s_per_day": 3.0,
    "turntable_0_deg": 0.3,
    "turntable_1_deg": -0.2,
    "lon_deg": 0.05,
    "lat_deg": -0.03,
    "tilt_east_deg": 0.4,
    "tilt_north_deg": 0.25,
}


def two_runs():
    return lb.Observation.from_runs([lb.Run(0.3), lb.Run(0.4, 30.0)], step_s=20000.0, window="mean")


def seen(pointing, beams):
    layout = DataLayout(16, pointing.n_times)
    return np.asarray(lb.CouplingMatrix.of_modes(beams.modes, pointing, layout) @ steep_sky(LMAX))


def sigma(v, o):
    return np.sqrt(paper_variance(v.reshape(16, -1)) / (1e6 * o.live_s)).ravel()


@pytest.mark.parametrize("axis", [0, 1])
def test_turns_about_horizontal_axes(axis):
    modes = np.random.default_rng(1).standard_normal((2, 49))
    vector = np.eye(3)[axis] * 0.7
    expected = Rotation.from_matrix(SpatialRotation.from_rotvec(vector).as_matrix(), 6)(modes)
    got = turn_about(axis, modes, 0.7)
    np.testing.assert_allclose(got, expected, rtol=0, atol=1e-13)


@pytest.mark.parametrize("names", [(name,) for name in VALUES] + [tuple(VALUES)])
def test_inside_a_compiled_function_as_exactly_shifted(names):
    o, beams = two_runs(), lb.monopole_beams(25.0, LMAX)
    values = {name: VALUES[name] for name in names}
    exact = seen(Pointing.of(with_offsets(o, values), LMAX), beams)
    nominal = Pointing.of(o, LMAX)
    got = seen(turned_by_offsets(nominal, o.hours, values), beams)
    before = seen(nominal, beams)
    moved = np.abs((exact - before) / sigma(exact, o)).max()
    left = np.abs((exact - got) / sigma(exact, o)).max()
    # the rate of the turn varies by 1e-4, and the pole wanders by 2e-8 rad within a minute
    clock = any(name.startswith("clock") for name in names)
    assert left < (1e-3 * moved if clock else 1e-6 + 1e-9 * moved)
    assert moved > 0.5


@pytest.mark.long
def test_offsets_are_differentiable():
    o, beams = two_runs(), lb.monopole_beams(25.0, 2)
    nominal = Pointing.of(o, 2)
    a = jnp.asarray(steep_sky(2))
    names = list(VALUES)

    def total(values):
        pointing = turned_by_offsets(nominal, o.hours, dict(zip(names, values, strict=True)))
        layout = DataLayout(16, o.n_times)
        v = lb.CouplingMatrix.of_modes(jnp.asarray(beams.modes), pointing, layout) @ a
        return (v * jnp.cos(jnp.arange(v.size))).sum()

    at = jnp.asarray(list(VALUES.values()))
    total = jax.jit(total)
    slopes = jax.jit(jax.grad(total))(at)
    for k in range(len(names)):
        step = 1e-3 * at[k]
        difference = total(at.at[k].add(step)) - total(at.at[k].add(-step))
        # rounding of 1e6 numbers of 1e4 K, and the third derivative
        np.testing.assert_allclose(slopes[k], difference / (2 * step), rtol=1e-5)


def test_a_leaning_lander_by_hand():
    """Its zenith leans towards East and North, and a source stands lower on the other side."""
    o = replace(lb.Observation.from_runs([lb.Run(0.01)]), tilt_deg=(2.0, 0.0))
    up = o.topocentric_from_mcmf() @ o.lander_from_mcmf().T @ [0.0, 0.0, 1.0]
    np.testing.assert_allclose(up, [np.sin(np.radians(2)), 0, np.cos(np.radians(2))], atol=1e-15)
    north = replace(o, tilt_deg=(0.0, 3.0))
    up = north.topocentric_from_mcmf() @ north.lander_from_mcmf().T @ [0.0, 0.0, 1.0]
    np.testing.assert_allclose(up, [0, np.sin(np.radians(3)), np.cos(np.radians(3))], atol=1e-15)
    # a source in the zenith is seen 3 degrees South of the antennas' own
    zenith = north.zenith_galactic()
    seen_at = north.antenna_directions(zenith)[0]
    expected = [0, -np.sin(np.radians(3)), np.cos(np.radians(3))]
    np.testing.assert_allclose(seen_at, expected, atol=1e-12)


def test_shifted_observations():
    o = two_runs()
    late = with_offsets(o, {"clock_s": 90.0, "clock_drift_s_per_day": 8.64})
    expected = 90.0 + 8.64 * o.hours / 24.0
    np.testing.assert_allclose((late.times - o.times).to_value(u.s), expected, atol=1e-6)
    np.testing.assert_allclose(late.live_s, o.live_s * 1.0001, rtol=1e-12)
    assert with_offsets(o, {"turntable_1_deg": 0.5}).turntable_deg == (0.0, 30.5)


def test_names():
    every = offset_names(tuple(OFFSETS), 2)
    assert every == tuple(VALUES)
    assert offset_names(("turntable_deg",), 1) == ("turntable_deg",)
    refuse("no offset 'clock'; did you mean 'clock_s'", offset_names, ("clock",), 1)
