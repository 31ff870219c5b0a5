"""The log-normal sky: T exp(s) and its harmonic coefficients."""

from functools import partial

import healpy
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from assertions import refuse
from reference import sphere
from scipy import stats

from lusee_bayes.core.arrays import on_device
from lusee_bayes.core.harmonics import map_to_modes, n_modes, synthesis_matrix
from lusee_bayes.core.sphere_grid import SphereGrid
from lusee_bayes.sky.galaxy import BRIGHT_SOURCES, diffuse_brightness, galaxy_map
from lusee_bayes.sky.positive_skies import LogNormalSky, deviation_spectrum
from lusee_bayes.sky.sky_source import galaxy_sky

LMAX, MHZ = 5, 25.0
LEVEL = np.array([0.5])
SPECTRUM = deviation_spectrum(LMAX, 0.2, -2.0, LEVEL)


def waves(theta, phi, lowest=1000.0):
    """A positive template that no low degree holds."""
    return lowest * np.exp(1.0 + np.cos(3.0 * theta) + np.sin(theta) * np.sin(phi))


@pytest.fixture(scope="module")
def sky() -> LogNormalSky:
    return LogNormalSky.of(waves, SPECTRUM, MHZ, BRIGHT_SOURCES[:2], band=40)


@pytest.fixture(scope="module")
def white(sky) -> np.ndarray:
    return np.random.default_rng(0).standard_normal((3, sky.size))


def by_quadrature(sky: LogNormalSky, white: np.ndarray) -> np.ndarray:
    """m of one u: a matrix of harmonics at the points of a rule of its own, source by source."""
    theta, phi, area = sphere(60, 130)
    harmonics = synthesis_matrix(theta, phi, LMAX)
    ell = np.floor(np.sqrt(np.arange(n_modes(LMAX)))).astype(int)
    logarithm = harmonics @ (np.sqrt(np.asarray(sky.spectrum)[ell]) * white[: n_modes(LMAX)])
    modes = harmonics.T @ (waves(theta, phi) * np.exp(logarithm) * area)
    for source, eta in zip(BRIGHT_SOURCES[:2], white[n_modes(LMAX) :], strict=True):
        modes = modes + stats.expon.ppf(stats.norm.cdf(eta)) * source.modes(MHZ, LMAX)
    return modes


def test_modes_are_integrals_of_the_template_times_exp(sky, white):
    found = sky.modes(white)
    assert found.shape == (3, n_modes(LMAX))
    for row, u in zip(found, white, strict=True):
        expected = by_quadrature(sky, u)
        # both rules resolve exp(s) to rounding; the template is entire
        np.testing.assert_allclose(row, expected, rtol=0, atol=1e-10 * np.abs(expected).max())


@pytest.mark.long
def test_jax_computes_the_same(sky, white):
    found = on_device(sky).modes(jnp.asarray(white))
    np.testing.assert_allclose(found, sky.modes(white), rtol=0, atol=1e-11 * float(found.max()))


def test_the_jacobian_is_the_derivative(sky, white):
    expected = np.asarray(jax.jit(jax.jacfwd(on_device(sky).modes))(jnp.asarray(white[0])))
    found = sky.jacobian(white[0])
    assert found.shape == (n_modes(LMAX), n_modes(LMAX) + 2)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12 * np.abs(expected).max())


def test_sources_have_exponential_fluxes(sky):
    factors = sky.source_factors(np.random.default_rng(0).standard_normal((4000, sky.size)))
    assert stats.kstest(factors.ravel(), "expon").pvalue > 1e-3
    far = np.concatenate([np.zeros((1, n_modes(LMAX))), [[-30.0, 8.0]]], axis=1)
    # -ln(1 - p) is p where p is tiny
    expected = stats.norm.cdf(-30.0), stats.expon.isf(stats.norm.sf(8.0))
    np.testing.assert_allclose(sky.source_factors(far)[0], expected, rtol=1e-12)


def test_a_power_law_leaves_the_level_alone(sky):
    changed = sky.with_power_law(0.05, -3.0).spectrum
    ell = np.arange(1, LMAX + 1)
    np.testing.assert_allclose(changed[1:], 0.05**2 * ((ell + 1) / 10.0) ** -3.0, rtol=1e-14)
    assert changed[0] == LEVEL[0]


def test_power_law_slopes_are_derivatives_of_the_root(sky):
    def root(theta):
        return jnp.log(sky.with_power_law(jnp.exp(theta[0]), theta[1]).root()[: n_modes(LMAX)])

    slopes = np.asarray(jax.jit(jax.jacfwd(root))(jnp.asarray([-2.0, -1.0]))).T
    np.testing.assert_allclose(sky.power_law_slopes(), slopes, atol=1e-14)


def test_refusals():
    nothing = partial(waves, lowest=0.0)
    refuse("template must be positive", LogNormalSky.of, nothing, SPECTRUM, MHZ, band=20)
    spectrum = np.where(np.arange(LMAX + 1) == 3, 0.0, SPECTRUM)
    refuse("spectrum of the logarithm must", LogNormalSky.of, waves, spectrum, MHZ, band=20)
    refuse("does not support harmonics", LogNormalSky.of, waves, SPECTRUM, MHZ, band=LMAX - 1)


def test_the_embedded_template_is_the_sky_without_its_random_part():
    smooth = galaxy_sky(25.0, 8, seed=None, sources=()).modes
    pixels = galaxy_map(25.0, 64, seed=None)
    # with it, synchrotron emission, most of the sky's, is multiplied by exp(g), of rms 5 %, and
    # loops and spurs
    ratio = galaxy_map(25.0, 64, seed=3) / pixels
    assert abs(ratio.mean() - 1.0) < 0.01 and 0.02 < np.log(ratio).std() < 0.08
    # its values in directions, and on pixels, are those of the same sky, whose edges are sharp
    grid = SphereGrid.of(8, 128)
    values = diffuse_brightness(25.0, *grid.directions()).reshape(grid.shape)
    np.testing.assert_allclose(grid.analyse(values), smooth, atol=1e-3 * smooth[0])
    np.testing.assert_allclose(map_to_modes(pixels, 8), smooth, rtol=1e-9)
    at = diffuse_brightness(25.0, *healpy.pix2ang(16, np.arange(healpy.nside2npix(16))))
    np.testing.assert_allclose(at, galaxy_map(25.0, 16, seed=None), rtol=1e-9)
