"""The embedded antennas and the ground below them, against sums along the arms and closed forms."""

import numpy as np
import pytest
from assertions import close, refuse, within
from reference import SPEED_OF_LIGHT, arm_response, layered_reflection, vectors

import lusee_bayes as lb
from lusee_bayes.instrument.beams.fields import HemisphereGrid
from lusee_bayes.instrument.beams.monopoles import Monopoles, Regolith

GRID = HemisphereGrid.gauss_legendre(6, 8)


LEANING = {"zenith_angle_deg": 100.0, "height_m": 0.7, "length_m": 2.5}


@pytest.mark.parametrize(("frequency", "options"), [(1.0, {}), (25.0, {}), (50.0, LEANING)])
def test_fields_agree_with_a_sum_along_the_arms(frequency, options):
    m = Monopoles(**options)
    fields = m.fields(frequency, GRID)
    s, p = m.regolith.reflection(np.cos(GRID.theta), frequency)
    scale = np.abs(fields.e_theta).max()
    antenna = {"frequency_mhz": frequency, "length": float(m.length_m), "height": float(m.height_m)}
    # North, East, South, West
    azimuths = np.radians([90.0, 0.0, 270.0, 180.0])
    arms = vectors(np.full(4, np.radians(float(m.zenith_angle_deg))), azimuths)
    for port, arm in enumerate(arms):
        for t in range(len(GRID.theta)):
            ground = complex(s[t]), complex(p[t])
            for f in range(0, GRID.n_phi, 3):
                towards = GRID.theta[t], GRID.phi[f]
                expected = arm_response(*towards, arm=arm, reflection=ground, **antenna)
                got = fields.e_theta[port, t, f], fields.e_phi[port, t, f]
                # Simpson's rule with 4000 steps of k h < 1e-3: 1e-13 of the integral
                np.testing.assert_allclose(got, expected, rtol=0, atol=1e-12 * scale)


def test_a_vertical_arm_over_a_conductor_has_its_image():
    frequency, height, conductor = 30.0, 1.5, Regolith(4.0, 4.0, 1e16)
    m = Monopoles(conductor, length_m=1e-4, zenith_angle_deg=0.0, height_m=height)
    k = 2e6 * np.pi * frequency / SPEED_OF_LIGHT
    e_theta = np.asarray(m.fields(frequency, GRID).e_theta[2])
    array_factor = 2 * np.cos(k * height * np.cos(GRID.theta))
    expected = np.abs(np.sin(GRID.theta) * array_factor) * k * 1e-8 / 2
    # the arm itself is k L = 6e-5 radians long
    within(np.abs(e_theta), np.tile(expected[:, None], (1, 8)), 1e-4 * expected.max())


@pytest.mark.long
@pytest.mark.parametrize(("frequency", "lmax"), [(50.0, 16), (25.0, 47)])
def test_coefficients_do_not_change_when_the_nodes_double(frequency, lmax):
    grid = HemisphereGrid.for_lmax(lmax)
    # a smaller lmax is a slice, so that both cases share two programs
    coarse, fine = (
        np.asarray(lb.monopole_beams(frequency, 47, nodes=nodes).modes)[:, : (lmax + 1) ** 2]
        for nodes in ((len(grid.theta), grid.n_phi), (2 * len(grid.theta), 2 * grid.n_phi))
    )
    # from 25 MHz to 50 the echoes of layers 14 m apart vary twice as fast over the 64 nodes
    close(coarse, fine, 1e-12 if frequency < 50.0 else 1e-11)


# --- reflection by the ground ---------------------------------------------------------------------


COSINES = np.cos(np.radians([0.0, 20.0, 45.0, 70.0, 85.0, 89.9]))


def test_permittivity_rises_linearly_over_the_layers():
    eps = np.asarray(Regolith(3.7, 6.1, 0.01).permittivities())
    np.testing.assert_allclose(eps.real, 3.7 + 2.4 * np.arange(8) / 7, rtol=1e-15)
    np.testing.assert_allclose(eps.imag, -0.01 * eps.real, rtol=1e-15)


# the square root loses half the digits of a cosine near zero; 1 - |r| of a conductor is
# 2 / (|n| cos theta) at worst, |n| = 2e8
LOSSY, NONE, CONDUCTOR = (5.0, 0.3, 1e-14), (1.0, 0.0, 1e-11), (4.0, 1e16, 2e-7)


@pytest.mark.parametrize(("eps", "loss", "atol"), [LOSSY, (4.0, 0.0, 1e-14), NONE, CONDUCTOR])
def test_uniform_ground_obeys_fresnel(eps, loss, atol):
    cosines = np.append(COSINES[:-1], 1.0) if loss > 1.0 else np.append(COSINES, 1.0)
    complex_eps = eps * (1 - 1j * loss)
    # the principal root decays: its imaginary part is negative
    n_cos_t = np.sqrt(complex_eps - (1 - cosines**2))
    s, p = Regolith(eps, eps, loss).reflection(cosines, 10.0)
    within(s, (cosines - n_cos_t) / (cosines + n_cos_t), atol)
    within(p, (complex_eps * cosines - n_cos_t) / (complex_eps * cosines + n_cos_t), atol)
    if loss > 1.0:
        within(s, -1.0, 1e-7)
        within(p, 1.0, 2e-7)


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


IMPOSSIBLE = [
    (Monopoles, {"length_m": 0.0}, "length_m must be positive"),
    (Monopoles, {"height_m": -1.0}, "height_m must be positive"),
    (Monopoles().fields, {"frequency_mhz": 0.0, "grid": GRID}, "frequency_mhz must be"),
    (Regolith, {"surface_permittivity": 0.0}, "permittivity must be positive"),
    (Regolith, {"deep_permittivity": np.nan}, "permittivity must be positive"),
    (Regolith, {"loss_tangent": -0.01}, "loss_tangent must not be negative"),
]


@pytest.mark.parametrize(("make", "given", "words"), IMPOSSIBLE)
def test_what_cannot_be_is_refused(make, given, words):
    refuse(words, make, **given)
