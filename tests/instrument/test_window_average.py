"""A as the mean over windows: against instants, by this package and by lunarsky itself."""

from dataclasses import replace

import astropy.units as u
import numpy as np
import pytest
from astropy.coordinates import ICRS, CartesianRepresentation, Galactic
from lunarsky import LunarTopo, MoonLocation

import lusee_bayes as lb
from lusee_bayes.core.harmonics import mode_numbers, n_modes
from lusee_bayes.core.rotations import Rotation
from lusee_bayes.instrument.times import unannounced_leap_seconds
from lusee_bayes.instrument.window_average import sufficient_nodes
from lusee_bayes.instrument.windows import Windows
from lusee_bayes.noise.radiometer import paper_variance


def galactic_sky(lmax):
    """C_ell ~ (1 + ell)^-2.5 around a monopole of 1e4 K."""
    ell, _ = mode_numbers(lmax)
    a = np.random.default_rng(0).standard_normal(n_modes(lmax))
    a *= 5e3 * (1.0 + ell) ** -1.25
    a[0] = 1e4 * np.sqrt(4 * np.pi)
    return a


def partly_filled(n, step_s, seed=1):
    """Whole windows, windows that end early, and windows with one or two gaps."""
    rng = np.random.default_rng(seed)
    sample, start, end, live = [], [], [], []
    for k in range(n):
        edges = np.sort(rng.uniform(-0.5, 0.5, 2 * (k % 4))) * step_s
        edges = np.concatenate([[-step_s / 2], edges, [step_s / 2]])
        if k % 4 == 1:  # one piece, without its end
            edges = edges[:2]
        for first, last in zip(edges[::2], edges[1::2], strict=True):
            sample.append(k)
            start.append(first)
            end.append(last)
            live.append(rng.uniform(0.3, 1.0) * (last - first))
    return Windows(np.array(sample), np.array(start), np.array(end), np.array(live))


def observation(step_s, filled):
    """Eight samples across a cycle, so that the pole has wandered between them."""
    whole = lb.Observation.from_runs([lb.Run(1.0, 20.0)], step_s=step_s, window="mean")
    keep = np.zeros(whole.n_times, dtype=bool)
    keep[np.linspace(0, whole.n_times - 1, 8).astype(int)] = True
    some = whole.select(keep)
    return replace(some, windows=partly_filled(8, step_s)) if filled else some


def nodes_of(windows, k, n):
    """n instants of sample k and their weights, piece by piece."""
    x, w = np.polynomial.legendre.leggauss(n)
    offsets, weights = [], []
    pieces = np.flatnonzero(windows.sample == k)
    for piece in pieces:
        a, b = windows.start_s[piece], windows.end_s[piece]
        offsets.append((a + b) / 2 + (b - a) / 2 * x)
        weights.append(w / 2 * windows.live_s[piece] / windows.live_s[pieces].sum())
    return np.concatenate(offsets), np.concatenate(weights)


def sigma_of(v, o):
    """Radiometer noise of one live time, 1 MHz wide."""
    return np.sqrt(paper_variance(v) / (1e6 * o.live_s))


@pytest.mark.parametrize("lmax", [12, pytest.param(47, marks=pytest.mark.long)])
@pytest.mark.parametrize("filled", [False, True])
@pytest.mark.parametrize("step_s", [10.0, 600.0, 7200.0, 43200.0])
def test_equals_the_mean_of_200_instants(step_s, filled, lmax):
    o, beams, sky = observation(step_s, filled), lb.monopole_beams(25.0, lmax), galactic_sky(lmax)
    got = np.asarray(lb.CouplingMatrix.observe(beams, o) @ sky).reshape(16, -1)
    expected = np.zeros_like(got)
    for k in range(o.n_times):
        offsets, weights = nodes_of(o.windows, k, 200)
        with unannounced_leap_seconds():
            times = o.times[k] + offsets * u.s
        run = np.zeros(len(times), dtype=int)
        instants = replace(o, times=times, run=run, windows=None)
        pointing = lb.Pointing.of(instants, lmax, order=4)
        v = np.asarray(lb.CouplingMatrix.build(beams, pointing) @ sky).reshape(16, -1)
        expected[:, k] = v @ weights
    off = (got - expected) / sigma_of(expected, o)
    assert np.abs(off).max() < 1e-6
    # and instants at the same times would not do
    instants = np.asarray(lb.CouplingMatrix.observe(beams, replace(o, windows=None)) @ sky)
    wrong = np.abs((instants.reshape(16, -1) - expected) / sigma_of(expected, o)).max()
    assert wrong > {10.0: 1e-8, 600.0: 1e-4, 7200.0: 0.1, 43200.0: 10.0}[step_s]


def antenna_frame(o, time):
    """From Galactic axes to those of the turned antennas, by lunarsky's LunarTopo."""
    site = MoonLocation.from_selenodetic(o.lon_deg * u.deg, o.lat_deg * u.deg, 0.0 * u.m)
    axes = Galactic(CartesianRepresentation(np.eye(3))).transform_to(ICRS())
    with unannounced_leap_seconds():
        there = axes.transform_to(LunarTopo(obstime=time, location=site))
    east, north, up = np.sin(there.az), np.cos(there.az), np.sin(there.alt)
    flat = np.cos(there.alt)
    topocentric = np.array([(flat * east).value, (flat * north).value, up.value])
    psi = np.radians(o.turntable_deg[0])
    back = np.array([[np.cos(psi), np.sin(psi), 0], [-np.sin(psi), np.cos(psi), 0], [0, 0, 1]])
    return back @ topocentric


@pytest.mark.parametrize(
    ("step_s", "filled", "lmax"),
    [(7200.0, False, 20), pytest.param(43200.0, True, 47, marks=pytest.mark.long)],
)
def test_equals_the_mean_of_20_instants_by_lunarsky(step_s, filled, lmax):
    o, beams, sky = observation(step_s, filled), lb.monopole_beams(25.0, lmax), galactic_sky(lmax)
    got = np.asarray(lb.CouplingMatrix.observe(beams, o) @ sky).reshape(16, -1)
    for k in (1, 2, 7):
        offsets, weights = nodes_of(o.windows, k, 20)
        expected = 0.0
        for offset, weight in zip(offsets, weights, strict=True):
            with unannounced_leap_seconds():
                time = o.times[k] + offset * u.s
            turned = Rotation.from_matrix(antenna_frame(o, time), lmax)(sky)
            expected = expected + weight * (np.asarray(beams.modes) @ turned)
        sigma = sigma_of(np.asarray(expected)[:, None], replace(o.select(np.arange(8) == k)))
        assert np.abs((got[:, k] - expected) / sigma[:, 0]).max() < 1e-6


def test_a_fixed_axis_gives_a_factor_for_each_order():
    """sin(m h) / (m h), h half of the angle of a window, where nothing wanders."""
    o = lb.Observation.from_runs([lb.Run(0.2)], step_s=7200.0, window="mean")
    p = lb.Pointing.of(o, 30, order=0)
    # the Moon's own turn, from its orientations at the ends of the windows
    with unannounced_leap_seconds():
        edges = replace(o, times=o.times - 3600.0 * u.s, windows=None)
    half = np.diff(np.unwrap(np.asarray(lb.Pointing.of(edges, 2).azimuth))) / 2.0
    got = np.asarray(p.functions)[:-1] @ np.asarray(p.factors)[:, 0, :, 0]
    m = np.arange(31)
    # what functions of time leave out
    np.testing.assert_allclose(got, np.sinc(m * half[:, None] / np.pi), rtol=0, atol=1e-8)
    # one function is all but exact: the rate of the turn varies by 1e-4
    alone = np.asarray(p.functions)[:-1, :1] * np.asarray(p.factors)[0, 0, :, 0]
    np.testing.assert_allclose(alone, got, rtol=0, atol=1e-4 * (30 * half.max()) ** 2)


@pytest.mark.parametrize("angle", [0.0, 1e-3, 0.3, 3.0])
def test_nodes_suffice(angle):
    x, w = np.polynomial.legendre.leggauss(sufficient_nodes(angle))
    assert w @ np.cos(angle * x) / 2 == pytest.approx(np.sinc(angle / np.pi), abs=2e-15 + 1e-14)


def test_windows_that_cannot_be():
    one = np.array([1.0])
    with pytest.raises(
        lb.InputError, match="sample 0 ends -1 s from its time, not after its start"
    ):
        Windows.whole(one, -one)
    with pytest.raises(lb.InputError, match="sample 0 was live for 3 s of a window of 2 s"):
        Windows.whole(-one, one, 3 * one)
    with pytest.raises(lb.InputError, match="sample 0 has a live time of 0 s"):
        Windows.whole(-one, one, 0 * one)
    with pytest.raises(lb.InputError, match="sample 0 has a piece that begins at 0.5 s, before"):
        Windows(np.array([0, 0]), np.array([0.0, 0.5]), np.array([1.0, 2.0]), np.ones(2))
    with pytest.raises(lb.InputError, match="must count the samples 0, 1"):
        Windows(np.array([0, 2]), np.zeros(2), np.ones(2), np.ones(2))
    none = np.zeros(0)
    with pytest.raises(lb.InputError, match="same length, with at least one piece"):
        Windows(none.astype(int), none, none, none)
    o = lb.Observation.from_runs([lb.Run(0.05)], window="mean")
    n = np.ones(o.n_times)
    with pytest.raises(
        lb.InputError, match="the window of sample 0 lasts 8000 s, longer than the st"
    ):
        replace(o, windows=Windows.whole(-4000 * n, 4000 * n))
    with pytest.raises(
        lb.InputError, match=r"samples 0 and 1 \(2027-01-15T01:00:00\) overlap by 600"
    ):
        replace(o, windows=Windows.whole(-3600 * n, 3600 * n + 600 * (o.hours == 0)), step_s=8e3)
    with pytest.raises(lb.InputError, match="windows of 3 samples for 16 times"):
        replace(o, windows=Windows.whole(-n[:3], n[:3]))
    with pytest.raises(lb.InputError, match="samples are instants; use observation.window=instant"):
        replace(o, fixed_axis=True)


def test_nodes_and_live_times():
    w = partly_filled(9, 100.0)
    sample, offset, weight = w.nodes(3)
    np.testing.assert_allclose(np.bincount(sample, weight), 1.0, rtol=1e-14)
    for k in range(9):
        pieces = w.sample == k
        assert w.live_per_sample_s[k] == pytest.approx(w.live_s[pieces].sum(), rel=1e-14)
        np.testing.assert_array_equal(
            w.bounds_s[k], [w.start_s[pieces].min(), w.end_s[pieces].max()]
        )
        # the mean of t^2 over the pieces, by hand
        exact = (w.end_s**3 - w.start_s**3) / 3 / (w.end_s - w.start_s) * w.live_s
        exact = exact[pieces].sum() / w.live_s[pieces].sum()
        assert weight[sample == k] @ offset[sample == k] ** 2 == pytest.approx(exact, rel=1e-12)
    keep = np.arange(9) % 3 == 0
    some = w.select(keep)
    np.testing.assert_array_equal(some.live_per_sample_s, w.live_per_sample_s[keep])
    assert "3 windows in" in repr(some)
