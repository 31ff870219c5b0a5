"""Offsets of clock and pointing, shifted exactly and inside compiled functions."""

from dataclasses import replace

import astropy.units as u
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation as SpatialRotation

import lusee_bayes as lb
from lusee_bayes.core.harmonics import mode_numbers, n_modes
from lusee_bayes.core.rotations import Rotation, turn_about_x, turn_about_y
from lusee_bayes.instrument.layout import DataLayout
from lusee_bayes.instrument.pointing_offsets import (
    OFFSETS,
    offset_names,
    turned_by_offsets,
    with_offsets,
)
from lusee_bayes.instrument.source_response import antenna_directions
from lusee_bayes.noise.radiometer import paper_variance

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


def sky():
    ell, _ = mode_numbers(LMAX)
    a = np.random.default_rng(0).standard_normal(n_modes(LMAX))
    a *= 5e3 * (1.0 + ell) ** -1.25
    a[0] = 1e4 * np.sqrt(4 * np.pi)
    return a


def seen(pointing, beams):
    layout = DataLayout(16, pointing.n_times)
    return np.asarray(lb.CouplingMatrix.of_modes(beams.modes, pointing, layout) @ sky())


def sigma(v, o):
    return np.sqrt(paper_variance(v.reshape(16, -1)) / (1e6 * o.live_s)).ravel()


@pytest.mark.parametrize("axis", [0, 1])
def test_turns_about_horizontal_axes(axis):
    modes = np.random.default_rng(1).standard_normal((2, 49))
    vector = np.eye(3)[axis] * 0.7
    expected = Rotation.from_matrix(SpatialRotation.from_rotvec(vector).as_matrix(), 6)(modes)
    got = (turn_about_x, turn_about_y)[axis](modes, 0.7)
    np.testing.assert_allclose(got, expected, rtol=0, atol=1e-13)


@pytest.mark.parametrize("names", [(name,) for name in VALUES] + [tuple(VALUES)])
def test_inside_a_compiled_function_as_exactly_shifted(names):
    o, beams = two_runs(), lb.monopole_beams(25.0, LMAX)
    values = {name: VALUES[name] for name in names}
    exact = seen(lb.Pointing.of(with_offsets(o, values), LMAX), beams)
    nominal = lb.Pointing.of(o, LMAX)
    got = seen(turned_by_offsets(nominal, o.hours, values), beams)
    before = seen(nominal, beams)
    moved = np.abs((exact - before) / sigma(exact, o)).max()
    left = np.abs((exact - got) / sigma(exact, o)).max()
    # the rate of the turn varies by 1e-4, and the pole wanders by 2e-8 rad within a minute
    clock = any(name.startswith("clock") for name in names)
    assert left < (1e-3 * moved if clock else 1e-6 + 1e-9 * moved)
    assert moved > 0.5


def test_offsets_are_differentiable():
    o, beams = two_runs(), lb.monopole_beams(25.0, LMAX)
    nominal = lb.Pointing.of(o, LMAX)
    a = jnp.asarray(sky())
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
    seen_at = antenna_directions(north, zenith)[0]
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
    with pytest.raises(lb.InputError, match="no offset 'clock'; did you mean 'clock_s'"):
        offset_names(("clock",), 1)
