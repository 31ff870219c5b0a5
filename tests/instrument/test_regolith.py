import jax.numpy as jnp
import numpy as np
import pytest
from closeness import within
from reference import layered_reflection

import lusee_bayes as lb

COSINES = np.cos(np.radians([0.0, 20.0, 45.0, 70.0, 85.0, 89.9]))


def uniform(permittivity, loss_tangent):
    return lb.Regolith(permittivity, permittivity, loss_tangent)


def test_permittivity_rises_linearly_over_the_layers():
    eps = np.asarray(lb.Regolith(3.7, 6.1, 0.01).permittivities())
    np.testing.assert_allclose(eps.real, 3.7 + 2.4 * np.arange(8) / 7, rtol=1e-15)
    np.testing.assert_allclose(eps.imag, -0.01 * eps.real, rtol=1e-15)


@pytest.mark.parametrize("frequency", [1.0, 50.0])
def test_uniform_ground_at_normal_incidence(frequency):
    n = np.sqrt(4.0)
    s, p = uniform(4.0, 0.0).reflection(np.ones(1), frequency)
    np.testing.assert_allclose(s, (1 - n) / (1 + n), rtol=0, atol=1e-15)
    np.testing.assert_allclose(p, (n - 1) / (n + 1), rtol=0, atol=1e-15)


def test_uniform_ground_obeys_fresnel():
    eps = 5.0 * (1 - 0.3j)
    sine2 = 1 - COSINES**2
    n_cos_t = np.sqrt(eps - sine2)  # the principal root decays: its imaginary part is negative
    s, p = uniform(5.0, 0.3).reflection(COSINES, 10.0)
    np.testing.assert_allclose(s, (COSINES - n_cos_t) / (COSINES + n_cos_t), rtol=0, atol=1e-14)
    within(p, (eps * COSINES - n_cos_t) / (eps * COSINES + n_cos_t), 1e-14)


def test_no_vertical_reflection_at_brewsters_angle():
    eps = 3.0
    brewster = np.cos(np.arctan(np.sqrt(eps)))
    s, p = uniform(eps, 0.0).reflection(np.array([brewster]), 30.0)
    assert abs(p[0]) < 1e-15
    assert s[0].real == pytest.approx((1 - eps) / (1 + eps), abs=1e-14)


def test_no_ground_reflects_nothing():
    s, p = uniform(1.0, 0.0).reflection(COSINES, 10.0)
    # the square root loses half the digits of a cosine near zero, relative to it
    np.testing.assert_allclose(s, 0.0, rtol=0, atol=1e-11)
    np.testing.assert_allclose(p, 0.0, rtol=0, atol=1e-11)


def test_a_perfect_conductor():
    s, p = uniform(4.0, 1e16).reflection(COSINES[:-1], 10.0)
    # 1 - |r| = 2 / (|n| cos theta) at worst, |n| = 2e8
    np.testing.assert_allclose(s, -1.0, rtol=0, atol=1e-7)
    np.testing.assert_allclose(p, 1.0, rtol=0, atol=2e-7)


def test_grazing_incidence_reflects_everything_with_reversed_sign():
    s, p = lb.Regolith().reflection(np.array([1e-9]), 25.0)
    # 2 eps cos theta / n: 4e-9
    np.testing.assert_allclose(s, -1.0, rtol=0, atol=1e-8)
    np.testing.assert_allclose(p, -1.0, rtol=0, atol=1e-8)


@pytest.mark.parametrize("seed", range(5))
def test_no_more_comes_back_than_arrives(seed):
    rng = np.random.default_rng(seed)
    ground = lb.Regolith(rng.uniform(1, 10), rng.uniform(1, 10), 10 ** rng.uniform(-4, 1))
    for frequency in (1.0, 7.0, 50.0):
        s, p = ground.reflection(rng.uniform(0, 1, 50), frequency)
        assert np.abs(s).max() <= 1.0
        assert np.abs(p).max() <= 1.0


@pytest.mark.parametrize("frequency", [1.0, 5.0, 25.0])
@pytest.mark.parametrize("ground", [(3.7, 6.1, 0.01), (8.0, 2.0, 0.02), (1.5, 9.0, 0.0)])
def test_layers_agree_with_characteristic_matrices(ground, frequency):
    regolith = lb.Regolith(*ground)
    s, p = regolith.reflection(COSINES, frequency)
    eps = np.asarray(regolith.permittivities())
    for k, cosine in enumerate(COSINES):
        expected = layered_reflection(eps, 100.0 / 7, cosine, frequency)
        # seven layers; the matrices' entries grow with the loss to e^3, so 1e-13 is rounding
        np.testing.assert_allclose([s[k], p[k]], expected, rtol=0, atol=1e-12)


@pytest.mark.parametrize("bad", [(0.0, 6.1), (3.7, -1.0), (np.nan, 6.1)])
def test_permittivities_are_positive(bad):
    with pytest.raises(lb.InputError, match="permittivity must be positive"):
        lb.Regolith(*bad)
    assert lb.Regolith(jnp.asarray(2.0)).surface_permittivity == 2.0


def test_a_ground_that_amplifies_is_refused():
    with pytest.raises(lb.InputError, match="loss_tangent must not be negative, got -0.01"):
        lb.Regolith(loss_tangent=-0.01)
