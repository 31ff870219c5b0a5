"""Coordinates of a log-normal sky's posterior, and its mode, against closed forms and searches."""

from dataclasses import replace
from functools import lru_cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import optimize

from lusee_bayes.core.arrays import on_device
from lusee_bayes.linear.information import Information
from lusee_bayes.sampling import log_normal_program as ln
from lusee_bayes.sampling.log_normal_prior import AMPLITUDE, STRUCTURE, TILT, LogNormalPrior
from lusee_bayes.sky.galaxy import BRIGHT_SOURCES, diffuse_brightness
from lusee_bayes.sky.positive_skies import LogNormalSky, deviation_spectrum
from lusee_bayes.sky.prior import DensePrior

MHZ, LMAX, TILTED = 25.0, 3, -2.0
LEVEL = np.array([4.0 * np.pi])


def log_normal(amplitude, lmax=LMAX, level=LEVEL, sources=()) -> LogNormalSky:
    spectrum = deviation_spectrum(lmax, amplitude, TILTED, level)
    return LogNormalSky.of(partial(diffuse_brightness, MHZ), spectrum, MHZ, sources, band=16)


def log_normal_prior(amplitude, widths) -> LogNormalPrior:
    expected = np.array([np.log(amplitude), TILTED])
    std = None if widths is None else np.array(widths)
    return LogNormalPrior(log_normal(amplitude), expected, std)


def informed(truth: np.ndarray) -> Information:
    """What data say that know combinations of 16 modes to 10 to 1e5 K; the template's is 1e5 K."""
    rng = np.random.default_rng(1)
    rotation = np.linalg.qr(rng.standard_normal((16, 16)))[0]
    precision = np.geomspace(1e-2, 1e-10, 16)
    matrix = (rotation * precision) @ rotation.T
    vector = rotation @ (np.sqrt(precision) * rng.standard_normal(16))
    return Information(matrix, vector, truth, *map(np.asarray, (96.0, 0.0, 96.0)))


@lru_cache
def information(amplitude: float = 0.03) -> Information:
    """Of a sky that departs from the template by 10 % on large scales."""
    sky = log_normal(amplitude, sources=BRIGHT_SOURCES[:1])
    return informed(sky.modes(np.random.default_rng(2).standard_normal(sky.size)))


@lru_cache
def mode() -> ln.LogNormalMode:
    return ln.find_mode(log_normal(0.03, sources=BRIGHT_SOURCES[:1]), information())


# --- the mode ---------------------------------------------------------------------------------


def test_the_mode_is_where_a_search_without_derivatives_finds_it():
    """A datum of the mean temperature, half as large again as the template's, known to 5 %."""
    sky = log_normal(0.1, lmax=0, sources=BRIGHT_SOURCES[:1])
    value = 1.5 * sky.modes(np.zeros(2))
    precision = float((0.05 * value[0]) ** -2)
    scalars = map(np.asarray, (0.0, -np.log(precision), 1.0))
    given = Information(np.array([[precision]]), np.zeros(1), value, *scalars)

    def energy(u):
        return float(given.chi2(sky.modes(u))) + u @ u

    best = optimize.minimize(energy, np.zeros(2), method="Nelder-Mead", tol=1e-10)
    np.testing.assert_allclose(ln.find_mode(sky, given).white, best.x, atol=1e-4)


def test_small_deviations_have_the_posterior_of_a_gaussian_sky():
    """s of 1e-4: exp(s) - 1 - s is 1e-8, of skies that the data know to 1e-5."""
    sky = log_normal(1e-4, level=np.array([1e-8]))
    root = sky.jacobian(np.zeros(sky.size))
    prior = DensePrior(np.linalg.cholesky(root @ root.T), mean=sky.modes(np.zeros(sky.size)))
    given = informed(sky.modes(np.random.default_rng(0).standard_normal(sky.size)))
    expected, found = given.posterior(prior), ln.find_mode(sky, given)
    std = np.asarray(expected.std())
    assert np.abs((found.information.reference - np.asarray(expected.mean)) / std).max() < 0.02
    half = np.linalg.solve(found.lower, found.jacobian.T)
    np.testing.assert_allclose(np.sqrt((half**2).sum(0)), std, rtol=1e-3)


def test_the_gradient_vanishes_at_the_mode():
    found = mode()
    sky, given = on_device((found.sky, found.information))

    def energy(u):
        shift = sky.modes(u) - given.reference
        return 0.5 * (shift @ (given.matrix @ shift) - 2.0 * given.vector @ shift + u @ u)

    slope = np.asarray(jax.jit(jax.grad(energy))(jnp.asarray(found.white)))
    # H^-1 measures it in standard deviations
    assert np.linalg.norm(np.linalg.solve(found.lower, slope)) < 1e-3


# --- straight coordinates ---------------------------------------------------------------------


@pytest.mark.parametrize("learned", [False, pytest.param(True, marks=pytest.mark.long)])
def test_straight_coordinates_are_one_to_one_with_the_determinant_they_say(learned):
    power_law = np.array([np.log(0.03), TILTED]) if learned else None
    covariance = np.array([[0.04, 0.01], [0.01, 0.09]]) if learned else None
    found = replace(mode(), power_law=power_law, covariance=covariance)
    coordinates = ln.straight_coordinates(found)
    z = jax.random.normal(jax.random.key(3), (coordinates.root.shape[0],), dtype=jnp.float64)
    x = coordinates.mean + coordinates.root @ z

    @jax.jit
    def flat(x):
        values, log_det = coordinates.to_values(x)
        return jnp.concatenate([values[name].reshape(-1) for name in coordinates.names]), log_det

    values, log_det = flat(x)
    assert float(jnp.abs(values - x).max()) > 1e-3
    back = jax.jit(lambda x: coordinates.from_values(coordinates.to_values(x)[0]))(x)
    np.testing.assert_allclose(back, x, rtol=0, atol=1e-11)
    derivative = jax.jit(jax.jacfwd(lambda x: flat(x)[0]))(x)
    # rounding errors of 1e-16 times a condition of 1e5
    assert float(log_det) == pytest.approx(np.linalg.slogdet(derivative)[1], abs=1e-8)
    assert (float(log_det) != 0.0) == learned


def test_energies_are_those_of_a_gaussian_in_straight_coordinates_only():
    coordinates, found = ln.straight_coordinates(mode()), mode()
    z = jax.random.normal(jax.random.key(0), (60, found.sky.size), dtype=jnp.float64)
    x = np.asarray(coordinates.mean)[None] + np.asarray(z @ coordinates.root.T)
    values, _ = jax.jit(jax.vmap(coordinates.to_values))(jnp.asarray(x))
    white = np.asarray(values[STRUCTURE])
    chi2 = np.array([float(found.information.chi2(m)) for m in found.sky.modes(white)])
    energy = 0.5 * (chi2 + (white**2).sum(1))
    assert (energy - 0.5 * (np.asarray(z) ** 2).sum(1)).std() < 1.0
    # what a Gaussian about the mode would draw contradicts the data: chi^2 of 96 scatters by 14
    bent = np.array([float(found.information.chi2(m)) for m in found.sky.modes(x)])
    assert np.median(bent - chi2) > 100.0


# --- C_ell that is learned --------------------------------------------------------------------


def test_the_learned_spectrum_has_the_highest_evidence_and_its_curvature():
    prior = log_normal_prior(0.02, (0.7, 0.5))
    found = ln.learn_spectrum(prior, information())
    best = found.power_law
    centre, std = np.array([np.log(0.02), TILTED]), np.array([0.7, 0.5])

    def log_posterior(theta):
        there = ln.find_mode(prior.sky.with_power_law(np.exp(theta[0]), theta[1]), information())
        of_data = -0.5 * (float(there.information.misfit) + there.white @ there.white)
        of_data -= np.log(np.diagonal(there.lower)).sum()
        return of_data - 0.5 * (((theta - centre) / std) ** 2).sum()

    top = log_posterior(best)
    for direction in np.linalg.cholesky(found.covariance).T:
        up, down = log_posterior(best + direction), log_posterior(best - direction)
        # a parabola of the Fisher information falls by 1/2; of 16 modes what these data say differs
        # from it by sqrt(2 / 16) of that: two standard deviations
        assert 0.5 * (up + down) - top == pytest.approx(-0.5, abs=0.35)
        assert 0.5 * (up - down) == pytest.approx(0.0, abs=0.1)


@pytest.mark.parametrize("widths", [None, (0.7, 0.5)])
def test_coordinates_are_those_of_the_sites_that_are_sampled(widths):
    prior = log_normal_prior(0.02, widths)
    coordinates = ln.coordinates_of(prior, information())
    assert coordinates.names == prior.sites
    assert coordinates.chart.names == (STRUCTURE, AMPLITUDE, TILT)
