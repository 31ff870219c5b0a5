"""The embedded antennas and the ground below them, against sums along the arms and closed forms."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest
from assertions import close, refuse, within
from reference import SPEED_OF_LIGHT, arm_response, layered_reflection, vectors

import lusee_bayes as lb
from lusee_bayes.core.harmonics import turn_about_z
from lusee_bayes.instrument.beams.fields import HemisphereGrid, stokes_beam
from lusee_bayes.instrument.beams.monopoles import PORT_AZIMUTHS_DEG, Monopoles, Regolith
from lusee_bayes.instrument.products import to_matrix

GRID = HemisphereGrid.gauss_legendre(6, 8)
NO_GROUND = Regolith(1.0, 1.0, 0.0)
CONDUCTOR = Regolith(4.0, 4.0, 1e16)


def arms(zenith_angle_deg):
    tilt = np.full(4, np.radians(zenith_angle_deg))
    return vectors(tilt, np.radians(PORT_AZIMUTHS_DEG))


@pytest.mark.parametrize(
    ("frequency", "options"),
    [(1.0, {}), (25.0, {}), (50.0, {"zenith_angle_deg": 100.0, "height_m": 0.7, "length_m": 2.5})],
)
def test_fields_agree_with_a_sum_along_the_arms(frequency, options):
    m = Monopoles(**options)
    fields = m.fields(frequency, GRID)
    s, p = m.regolith.reflection(np.cos(GRID.theta), frequency)
    scale = np.abs(fields.e_theta).max()
    for port, arm in enumerate(arms(float(m.zenith_angle_deg))):
        for t in range(len(GRID.theta)):
            for f in range(0, GRID.n_phi, 3):
                expected = arm_response(
                    GRID.theta[t],
                    GRID.phi[f],
                    frequency_mhz=frequency,
                    length=float(m.length_m),
                    arm=arm,
                    height=float(m.height_m),
                    reflection=(complex(s[t]), complex(p[t])),
                )
                got = fields.e_theta[port, t, f], fields.e_phi[port, t, f]
                # Simpson's rule with 4000 steps of k h < 1e-3: 1e-13 of the integral
                np.testing.assert_allclose(got, expected, rtol=0, atol=1e-12 * scale)


def test_a_vertical_arm_over_a_conductor_has_its_image():
    frequency, height = 30.0, 1.5
    m = Monopoles(CONDUCTOR, length_m=1e-4, zenith_angle_deg=0.0, height_m=height)
    k = 2e6 * np.pi * frequency / SPEED_OF_LIGHT
    e_theta = np.asarray(m.fields(frequency, GRID).e_theta[2])
    array_factor = 2 * np.cos(k * height * np.cos(GRID.theta))
    expected = np.abs(np.sin(GRID.theta) * array_factor) * k * 1e-8 / 2
    # the arm itself is k L = 6e-5 radians long
    within(np.abs(e_theta), np.tile(expected[:, None], (1, 8)), 1e-4 * expected.max())


def test_ports_point_north_east_south_west():
    # a short arm in free space sees least along itself
    m = Monopoles(NO_GROUND, length_m=1e-3, zenith_angle_deg=90.0)
    grid = HemisphereGrid(np.array([np.pi / 2 - 1e-5]), np.ones(1), 4)  # E, N, W, S
    power = np.asarray(stokes_beam(m.fields(1.0, grid)))[range(4), range(4), 0].real
    horizon = {"E": 0, "N": 1, "W": 2, "S": 3}
    for port, (along, across) in enumerate(["NE", "EN", "SE", "WN"]):
        assert power[port, horizon[along]] < 1e-8 * power[port, horizon[across]]
    # and the tip side: the arm's phase centre lies towards its tip, the wave from there is ahead
    phase = np.asarray(Monopoles(NO_GROUND, length_m=1.0).fields(25.0, grid).e_theta)[:, 0]
    for port, tip in enumerate("NESW"):
        angles = np.angle(phase[port] / phase[port].sum())
        assert np.argmax(angles) == horizon[tip]


def test_a_quarter_turn_moves_each_port_to_the_next():
    beams = lb.monopole_beams(25.0, 8).modes
    # from East towards North: N -> W, E -> N, S -> E, W -> S, so i -> i - 1
    turned = np.asarray(to_matrix(turn_about_z(beams, np.pi / 2)))
    here = np.asarray(to_matrix(beams))
    previous = (np.arange(4) - 1) % 4
    within(turned, here[previous][:, previous], 1e-13 * here.real.max())
    # a uniform sky sees no difference between the ports, and one between the autos and the crosses
    assert np.ptp(here[range(4), range(4), 0].real) < 1e-15
    assert np.abs(here[0, 1] - here[0, 0]).max() > 0.01


def test_the_cross_of_opposite_arms_has_the_parities_of_the_cross():
    # half a turn swaps the arms: B_02(phi + pi) = conj B_02(phi). So Re B_02 holds even m only,
    # Im B_02 odd m only; the mirror East <-> West keeps both arms, so that both are even in x
    modes = lb.monopole_beams(25.0, 8)
    ell = np.repeat(np.arange(9), 2 * np.arange(9) + 1)
    m = np.arange(81) - ell * (ell + 1)
    real, imag = (np.asarray(modes.modes[modes.labels.index(label)]) for label in ("02R", "02I"))
    scale = np.abs(real).max()
    assert np.abs(real[m % 2 == 1]).max() < 1e-14 * scale
    assert np.abs(imag[m % 2 == 0]).max() < 1e-14 * scale
    # x -> -x is phi -> pi - phi: cos m phi -> (-1)^m cos, sin -> -(-1)^m sin
    flipped = np.where(m >= 0, 1.0, -1.0) * (-1.0) ** m
    np.testing.assert_allclose(real * flipped, real, rtol=0, atol=1e-14 * scale)
    np.testing.assert_allclose(imag * flipped, imag, rtol=0, atol=1e-14 * scale)
    assert np.abs(imag).max() > 1e-2 * scale  # "the crosses are complex"


@pytest.mark.long
@pytest.mark.parametrize(("frequency", "lmax"), [(50.0, 16), (25.0, 47)])
def test_coefficients_do_not_change_when_the_nodes_double(frequency, lmax):
    grid = HemisphereGrid.for_lmax(lmax)
    finer = 2 * len(grid.theta), 2 * grid.n_phi
    # a smaller lmax is a slice, so that both cases share two programs
    coarse, fine = (
        np.asarray(lb.monopole_beams(frequency, 47, nodes=nodes).modes)[:, : (lmax + 1) ** 2]
        for nodes in ((len(grid.theta), grid.n_phi), finer)
    )
    # from 25 MHz to 50 the echoes of layers 14 m apart vary twice as fast over the 64 nodes
    tolerance = 1e-12 if frequency < 50.0 else 1e-11
    close(coarse, fine, tolerance)


def test_bad_parameters_are_refused():
    refuse(r"length_m must be positive, got 0.0", Monopoles, length_m=0.0)
    refuse(r"height_m must be positive, got -1.0", Monopoles, height_m=-1.0)
    refuse(r"frequency_mhz must be positive, got 0.0", Monopoles().fields, 0.0, GRID)


# --- reflection by the ground ---------------------------------------------------------------------


COSINES = np.cos(np.radians([0.0, 20.0, 45.0, 70.0, 85.0, 89.9]))


def uniform(permittivity, loss_tangent):
    return Regolith(permittivity, permittivity, loss_tangent)


def test_permittivity_rises_linearly_over_the_layers():
    eps = np.asarray(Regolith(3.7, 6.1, 0.01).permittivities())
    np.testing.assert_allclose(eps.real, 3.7 + 2.4 * np.arange(8) / 7, rtol=1e-15)
    np.testing.assert_allclose(eps.imag, -0.01 * eps.real, rtol=1e-15)


# the square root loses half the digits of a cosine near zero; 1 - |r| of a conductor is
# 2 / (|n| cos theta) at worst, |n| = 2e8
@pytest.mark.parametrize(
    ("eps", "loss", "atol"),
    [(5.0, 0.3, 1e-14), (4.0, 0.0, 1e-14), (1.0, 0.0, 1e-11), (4.0, 1e16, 2e-7)],
    ids=["lossy", "lossless", "none", "conductor"],
)
def test_uniform_ground_obeys_fresnel(eps, loss, atol):
    cosines = np.append(COSINES[:-1], 1.0) if loss > 1.0 else np.append(COSINES, 1.0)
    complex_eps = eps * (1 - 1j * loss)
    # the principal root decays: its imaginary part is negative
    n_cos_t = np.sqrt(complex_eps - (1 - cosines**2))
    s, p = uniform(eps, loss).reflection(cosines, 10.0)
    within(s, (cosines - n_cos_t) / (cosines + n_cos_t), atol)
    within(p, (complex_eps * cosines - n_cos_t) / (complex_eps * cosines + n_cos_t), atol)
    if loss > 1.0:
        within(s, -1.0, 1e-7)
        within(p, 1.0, 2e-7)


def test_grazing_incidence_reflects_everything_with_reversed_sign():
    s, p = Regolith().reflection(np.array([1e-9]), 25.0)
    # 2 eps cos theta / n: 4e-9
    np.testing.assert_allclose(s, -1.0, rtol=0, atol=1e-8)
    np.testing.assert_allclose(p, -1.0, rtol=0, atol=1e-8)


@pytest.mark.parametrize("seed", range(5))
def test_no_more_comes_back_than_arrives(seed):
    rng = np.random.default_rng(seed)
    ground = Regolith(rng.uniform(1, 10), rng.uniform(1, 10), 10 ** rng.uniform(-4, 1))
    for frequency in (1.0, 7.0, 50.0):
        s, p = ground.reflection(rng.uniform(0, 1, 50), frequency)
        assert np.abs(s).max() <= 1.0
        assert np.abs(p).max() <= 1.0


@pytest.mark.parametrize("frequency", [1.0, 5.0, 25.0])
@pytest.mark.parametrize("ground", [(3.7, 6.1, 0.01), (8.0, 2.0, 0.02), (1.5, 9.0, 0.0)])
def test_layers_agree_with_characteristic_matrices(ground, frequency):
    regolith = Regolith(*ground)
    s, p = regolith.reflection(COSINES, frequency)
    eps = np.asarray(regolith.permittivities())
    for k, cosine in enumerate(COSINES):
        expected = layered_reflection(eps, 100.0 / 7, cosine, frequency)
        # seven layers; the matrices' entries grow with the loss to e^3, so 1e-13 is rounding
        np.testing.assert_allclose([s[k], p[k]], expected, rtol=0, atol=1e-12)


@pytest.mark.parametrize("bad", [(0.0, 6.1), (3.7, -1.0), (np.nan, 6.1)])
def test_permittivities_are_positive(bad):
    refuse("permittivity must be positive", Regolith, *bad)
    assert Regolith(jnp.asarray(2.0)).surface_permittivity == 2.0


def test_a_ground_that_amplifies_is_refused():
    refuse("loss_tangent must not be negative, got -0.01", Regolith, loss_tangent=-0.01)
