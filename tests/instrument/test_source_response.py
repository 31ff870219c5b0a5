import astropy.units as u
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from assertions import close, refuse
from astropy.time import Time
from reference import hemisphere, real_harmonics, vectors
from scipy import signal, special

import lusee_bayes as lb
from lusee_bayes.instrument.beams import monopoles as mp
from lusee_bayes.instrument.beams.fields import STOKES
from lusee_bayes.instrument.products import to_matrix

FREQUENCY = 25.0
SHORT = mp.Monopoles(mp.Regolith(1.0, 1.0, 0.0), length_m=1e-3, zenith_angle_deg=90.0)  # free space
ZENITH = np.array([[0.0, 0.0, 1.0]])


def observation(turntable=(0.0, 35.0, -110.0), step_s=10800.0, cycles=0.35):
    return lb.Observation.from_runs([lb.Run(cycles, angle) for angle in turntable], step_s=step_s)


# samples of that observation
N_TIMES = 228


def towards(frequency, directions, monopoles=None, stokes="I"):
    """The beams in up to N_TIMES directions, by the one program that serves all samples, too."""
    repeated = np.resize(directions, (N_TIMES, 3))
    beams = mp.beams_towards(frequency, repeated, monopoles, stokes=stokes)
    return np.asarray(beams)[:, : len(directions)]


# --- the beams in chosen directions


@pytest.mark.long
@pytest.mark.parametrize("stokes", STOKES)
def test_their_integrals_with_harmonics_are_the_modes(stokes):
    lmax = 8
    theta, phi, solid_angle = hemisphere(160, 48)
    beams = np.asarray(mp.beams_towards(FREQUENCY, vectors(theta, phi), stokes=stokes))
    got = (beams * solid_angle) @ real_harmonics(theta, phi, lmax)
    expected = np.asarray(lb.monopole_beams(FREQUENCY, lmax, stokes=stokes).modes)
    # both sums over Gauss nodes have converged (test_monopoles.py: 1e-12 at 25 MHz)
    close(got, expected, 2e-12)
    assert np.abs(expected).max() > 1e-3


def test_below_the_horizon_they_are_exactly_zero():
    down = np.array([[1.0, 0.0, 0.0], [0.0, 0.6, -0.8], [0.0, 0.0, -1.0], [1.0, 0.0, -1e-18]])
    for stokes in "IV":
        assert not towards(FREQUENCY, down, stokes=stokes).any()
    # and they fall to zero as the square of the height: at grazing incidence the ground cancels
    grazing = vectors(np.pi / 2 - np.array([1e-3, 1e-4]), np.array([0.3, 0.3]))
    higher, lower = towards(FREQUENCY, grazing)[0]
    assert higher / lower == pytest.approx(100.0, rel=0.02)


@pytest.mark.long
def test_gradients_are_finite_and_right_with_sources_below_the_horizon():
    directions = np.array([[0.6, 0.0, 0.8], [0.0, 0.0, 1.0], [0.0, 0.6, -0.8], [0.0, -1.0, 0.0]])
    weights = jnp.asarray(np.random.default_rng(1).standard_normal((16, 4)))

    @eqx.filter_jit
    def f(monopoles, directions):
        return jnp.sum(weights * mp.beams_towards(FREQUENCY, directions, monopoles))

    m = mp.Monopoles()
    slopes = eqx.filter_grad(f)(m, jnp.asarray(directions))
    leaves = jax.tree.leaves(slopes)
    assert len(leaves) == len(jax.tree.leaves(m))
    for leaf in leaves:
        # true of no NaN either
        assert 1e-6 < np.abs(np.asarray(leaf)).max() < 1e6
    h = 1e-4
    moved = (eqx.tree_at(lambda x: x.height_m, m, jnp.asarray(2.0 + s)) for s in (h, -h))
    up, down = (float(f(antennas, jnp.asarray(directions))) for antennas in moved)
    # third derivative of order (2 k)^3 = 1: h^2; rounding 1e-15 / h
    assert float(slopes.height_m) == pytest.approx((up - down) / (2 * h), rel=1e-6, abs=1e-9)
    hidden = eqx.filter_grad(f)(m, jnp.asarray(directions[[2, 2, 3, 3]]))
    assert all(not np.asarray(leaf).any() for leaf in jax.tree.leaves(hidden))
    # in the directions too, but at the zenith; below the horizon there is nothing to change
    others = jnp.asarray(directions[[0, 0, 2, 3]])
    slopes = np.asarray(jax.jit(jax.grad(lambda n: f(m, n)))(others))
    assert not slopes[2:].any()
    for axis in range(3):
        step = jnp.zeros((4, 3)).at[0, axis].set(h)
        difference = (float(f(m, others + step)) - float(f(m, others - step))) / (2 * h)
        assert slopes[0, axis] == pytest.approx(difference, rel=1e-6, abs=1e-7)


def test_the_frequency_may_be_traced():
    directions = vectors(np.array([0.3, 1.2]), np.array([0.1, 2.0]))
    many = jax.lax.map(lambda f: mp.beams_towards(f, directions), jnp.asarray([20.0, 25.0]))
    for one, frequency in zip(many, (20.0, 25.0), strict=True):
        np.testing.assert_allclose(one, towards(frequency, directions), rtol=0, atol=1e-13)


# --- polarisation


@pytest.mark.parametrize("stokes_v", [1.0, -1.0])
def test_a_field_that_turns_in_time(stokes_v):
    """A real field turns around; the arms' real voltages are correlated as a correlator does.

    By the IAU's definition V > 0 is right-handed: seen by a receiver that looks towards the source,
    the field turns counter-clockwise.
    """
    directions = vectors(np.array([0.0, 0.4, 1.0, 1.4]), np.array([0.0, 2.0, -2.5, 0.7]))
    arms = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [-1.0, 0.0, 0.0]])
    phase = 2 * np.pi * np.arange(64) / 16  # four periods
    expected = []
    for n in directions:
        a = np.cross(n, [0.3, -0.8, 0.5])
        a /= np.linalg.norm(a)
        # from a to b is counter-clockwise for whoever has n in front: a x b points at him, along -n
        b = np.cross(a, n)
        np.testing.assert_allclose(np.cross(a, b), -n, atol=1e-15)
        field = np.cos(phase)[:, None] * a + stokes_v * np.sin(phase)[:, None] * b
        # of real voltages, the part that turns as exp(+i w t); the wave carries I = 1
        signals = signal.hilbert(field @ arms.T, axis=0) / np.sqrt(2.0)
        expected.append(signals.T @ signals.conj() / len(phase))
    # in units of the autos' integral, of (1 - (n.arm)^2) / 2 over half the sphere
    norm = 2.0 * np.pi / 3.0
    got = towards(1.0, directions, SHORT) + stokes_v * towards(1.0, directions, SHORT, stokes="V")
    got = np.moveaxis(np.asarray(to_matrix(jnp.asarray(got))), -1, 0)
    # arms of a millimetre have their middles up to 2 k L / 3 = 1.4e-5 radians apart
    np.testing.assert_allclose(got, np.array(expected) / norm, rtol=0, atol=5e-6)
    # North and East at the zenith
    assert np.sign(got[0, 0, 1].imag) == stokes_v


# --- at every sample


def smoothed_source(n0, sigma, lmax):
    """Modes of a Gaussian of 1 K sr around n0: g_l Y_lm(n0), and its g_l."""
    ell = np.arange(lmax + 1)
    g, n0 = np.exp(-ell * (ell + 1) * sigma**2 / 2), n0[None]
    y = real_harmonics(np.arccos(n0[:, 2]), np.arctan2(n0[:, 1], n0[:, 0]), lmax)[0]
    return y * np.repeat(g, 2 * ell + 1), g


def around(n0, g, reach, n_radius, n_angle):
    """Directions around n0 and the integral of the smoothed source over the cell of each."""
    x, w = np.polynomial.legendre.leggauss(n_radius)
    height = 1 - np.cos(reach)  # Gauss nodes in sqrt(1 - cos gamma), about the radius
    root = (x + 1) / 2 * np.sqrt(height)
    cosine, ring = 1 - root**2, w / 2 * np.sqrt(height) * 2 * root * 2 * np.pi / n_angle
    terms = ((2 * ell + 1) * g[ell] * special.eval_legendre(ell, cosine) for ell in range(len(g)))
    kernel, across = sum(terms) / (4 * np.pi), np.cross(n0, [0.0, 0.0, 1.0])
    across /= np.linalg.norm(across)
    other, alpha = np.cross(n0, across), 2 * np.pi * (np.arange(n_angle) + 0.5) / n_angle
    offset = np.cos(alpha)[:, None] * across + np.sin(alpha)[:, None] * other
    n = cosine[:, None, None] * n0 + np.sqrt(1 - cosine**2)[:, None, None] * offset
    return n.reshape(-1, 3), np.repeat(kernel * ring, n_angle)


@pytest.mark.long
def test_a_smoothed_source_agrees_with_the_coupling_matrix():
    sigma, lmax = np.radians(9.0), 47
    o = observation(step_s=2 * 86400.0)
    n0 = o.zenith_galactic()[2] + np.array([0.1, 0.25, -0.2])
    n0 /= np.linalg.norm(n0)
    modes, g = smoothed_source(n0, sigma, lmax)
    coupling = lb.CouplingMatrix.observe(lb.monopole_beams(FREQUENCY, lmax), o)
    expected = np.asarray(coupling @ jnp.asarray(modes)).reshape(16, o.n_times)
    n, weights = around(n0, g, 6.0 * sigma, 28, 36)
    np.testing.assert_allclose(weights.sum(), 1.0, rtol=0, atol=1e-6)

    def integral(turntable):
        # every sample once for each direction, microseconds apart: the Moon turns by 3e-9 meanwhile
        apart = np.tile(1e-6 * np.arange(len(n)), o.n_times)
        times = Time(np.repeat(o.times.jd, len(n)), format="jd", scale="utc") + apart * u.s
        run = np.repeat(o.run, len(n))
        copies = lb.Observation(o.lon_deg, o.lat_deg, times, run, turntable, o.step_s)
        each = mp.source_response(copies, np.tile(n, (o.n_times, 1)), FREQUENCY)
        return np.asarray(each).reshape(16, o.n_times, len(n)) @ weights

    scale = np.abs(expected).max()
    # g_47 = 8e-13, so both hold the whole source but for the grid's tail beyond 6 sigma (1e-8) and
    # the kink at the horizon, which decides the error of the sum over directions: 9e-7
    assert np.abs(integral(o.turntable_deg) - expected).max() / scale < 5e-6
    sine = o.zenith_galactic() @ n0
    assert sine.min() < -0.35 and sine.max() > 0.77
    # the turntable the wrong way, or not at all
    for wrong in (tuple(-t for t in o.turntable_deg), (0.0,) * 3):
        assert np.abs(integral(wrong) - expected).max() > 0.1 * scale


def test_a_moving_source_is_a_fixed_one_at_every_sample():
    o = observation()
    path = vectors(np.linspace(0.5, 2.5, o.n_times), np.linspace(0.0, 5.0, o.n_times))
    moving = np.asarray(mp.source_response(o, path, FREQUENCY))
    assert o.n_times == N_TIMES
    for k in (0, 34, o.n_times - 1):
        fixed = np.asarray(mp.source_response(o, path[k], FREQUENCY))
        np.testing.assert_array_equal(moving[:, k], fixed[:, k])


def test_the_circularly_polarised_part_enters_by_the_v_beam():
    o = observation()
    galactic = o.zenith_galactic()[24]

    def seen(v):
        return mp.source_response(o, galactic, FREQUENCY, stokes_v=v)

    intensity, half = (np.asarray(seen(v)) for v in (0.0, 0.5))
    circular = mp.beams_towards(FREQUENCY, o.antenna_directions(galactic), stokes="V")
    np.testing.assert_allclose(half - intensity, 0.5 * circular, rtol=0, atol=1e-15)
    slope = jax.grad(lambda v: jnp.sum(seen(v)[2]))(jnp.asarray(0.0))
    assert float(slope) == pytest.approx(float(circular[2].sum()), rel=1e-12)


# --- bad input


def test_bad_directions_and_sources_are_refused():
    o, towards, response = observation(), mp.beams_towards, mp.source_response
    refuse(r"frequency_mhz.*positive.*0\.0", towards, 0.0, ZENITH)
    refuse(r"unit vectors.*number 0.*1\.1", towards, FREQUENCY, 1.1 * ZENITH)
    for bad in (-1.5, np.nan):
        refuse(f"from -1 to 1, got {bad}", response, o, ZENITH[0], FREQUENCY, stokes_v=bad)
    refuse("unit vectors.*number 0.*length 2", response, o, 2.0 * ZENITH[0], FREQUENCY)
    refuse("galactic has shape", response, o, np.zeros((2, 3)), FREQUENCY)
