"""The pointing, and offsets of it that are shifted exactly and inside compiled functions."""

from dataclasses import replace
from math import factorial

import astropy.units as u
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from assertions import refuse
from reference import steep_sky
from scipy.linalg import expm

import lusee_bayes as lb
from lusee_bayes.core.harmonics import generators
from lusee_bayes.instrument import pointing as pt
from lusee_bayes.instrument.products import DataLayout
from lusee_bayes.noise.radiometer import paper_variance


@pytest.mark.parametrize(("cycles", "wander"), [(1, 0.044), (3, 0.083)])
def test_the_axis_wanders_as_far_as_the_moons_pole_does(cycles, wander):
    o = lb.Observation.from_runs([lb.Run(1.0)] * cycles)
    pole = o.mcmf_from_galactic[:, 2]  # the Moon's z axis in Galactic coordinates
    mean = pole.mean(axis=0)
    angle = np.degrees(np.arctan2(np.linalg.norm(np.cross(pole, mean), axis=1), pole @ mean))
    assert angle.max() == pytest.approx(wander, abs=5e-4)  # DESIGN section 5, to its digits


@pytest.mark.parametrize("lmax", [4, 12])
@pytest.mark.parametrize("size", [0.0, 1e-7, 1e-4, 1e-3, 1e-2])
def test_sufficient_order_is_the_lowest_that_bounds_the_series(size, lmax):
    tilt = np.array([[0.6 * size, -0.8 * size], [0.0, 0.0]])
    order = pt.sufficient_order(tilt, lmax)
    # the error of the truncated series at the highest ell, by matrix exponentials
    k_x, k_y, _ = generators(lmax)
    generator = tilt[0, 0] * k_x + tilt[0, 1] * k_y
    exact = expm(generator)

    def error(n):
        series = sum(np.linalg.matrix_power(generator, i) / factorial(i) for i in range(n + 1))
        return np.linalg.norm(series - exact, 2)

    assert error(order) <= pt.TILT_TOLERANCE
    if order > pt.LEAST_ORDER:
        # the highest eigenvalue of the generator is i lmax |tilt|: the bound is reached
        assert error(order - 1) > 0.9 * pt.TILT_TOLERANCE


# --- offsets of clock and pointing ----------------------------------------------------------------


LMAX = 12
VALUES = {"clock_s": 60.0, "clock_drift_s_per_day": 3.0}
VALUES |= {"turntable_0_deg": 0.3, "turntable_1_deg": -0.2, "lon_deg": 0.05, "lat_deg": -0.03}
VALUES |= {"tilt_east_deg": 0.4, "tilt_north_deg": 0.25}


def two_runs():
    return lb.Observation.from_runs([lb.Run(0.3), lb.Run(0.4, 30.0)], step_s=20000.0, window="mean")


def seen(pointing, beams):
    layout = DataLayout(16, pointing.n_times)
    return np.asarray(lb.CouplingMatrix.of_modes(beams.modes, pointing, layout) @ steep_sky(LMAX))


def sigma(v, o):
    return np.sqrt(paper_variance(v.reshape(16, -1)) / (1e6 * o.live_s)).ravel()


@pytest.mark.parametrize("names", [(name,) for name in VALUES] + [tuple(VALUES)])
def test_inside_a_compiled_function_as_exactly_shifted(names):
    o, beams = two_runs(), lb.monopole_beams(25.0, LMAX)
    values = {name: VALUES[name] for name in names}
    exact = seen(pt.Pointing.of(pt.with_offsets(o, values), LMAX), beams)
    nominal = pt.Pointing.of(o, LMAX)
    got = seen(pt.turned_by_offsets(nominal, o.hours, values), beams)
    moved = np.abs((exact - seen(nominal, beams)) / sigma(exact, o)).max()
    left = np.abs((exact - got) / sigma(exact, o)).max()
    # the rate of the turn varies by 1e-4, and the pole wanders by 2e-8 rad within a minute
    clock = any(name.startswith("clock") for name in names)
    assert left < (1e-3 * moved if clock else 1e-6 + 1e-9 * moved)
    assert moved > 0.5


@pytest.mark.long
def test_offsets_are_differentiable():
    o, beams = two_runs(), lb.monopole_beams(25.0, 2)
    nominal = pt.Pointing.of(o, 2)
    a, names = jnp.asarray(steep_sky(2)), list(VALUES)

    def total(values):
        pointing = pt.turned_by_offsets(nominal, o.hours, dict(zip(names, values, strict=True)))
        layout = DataLayout(16, o.n_times)
        v = lb.CouplingMatrix.of_modes(jnp.asarray(beams.modes), pointing, layout) @ a
        return (v * jnp.cos(jnp.arange(v.size))).sum()

    at, total = jnp.asarray(list(VALUES.values())), jax.jit(total)
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
    seen_at = north.antenna_directions(north.zenith_galactic())[0]
    expected = [0, -np.sin(np.radians(3)), np.cos(np.radians(3))]
    np.testing.assert_allclose(seen_at, expected, atol=1e-12)


def test_shifted_observations():
    o = two_runs()
    late = pt.with_offsets(o, {"clock_s": 90.0, "clock_drift_s_per_day": 8.64})
    expected = 90.0 + 8.64 * o.hours / 24.0
    np.testing.assert_allclose((late.times - o.times).to_value(u.s), expected, atol=1e-6)
    np.testing.assert_allclose(late.live_s, o.live_s * 1.0001, rtol=1e-12)
    assert pt.with_offsets(o, {"turntable_1_deg": 0.5}).turntable_deg == (0.0, 30.5)


def test_names():
    assert pt.offset_names(tuple(pt.OFFSETS), 2) == tuple(VALUES)
    assert pt.offset_names(("turntable_deg",), 1) == ("turntable_deg",)
    refuse("offset 'clock'.*'clock_s'", pt.offset_names, ("clock",), 1)


def test_a_negative_order_is_refused():
    refuse("order of the tilt", pt.Pointing.of, two_runs(), 3, order=-1)
