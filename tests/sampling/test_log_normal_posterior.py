"""The posterior of a log-normal sky against quadrature, closed forms and searches."""

from __future__ import annotations

from functools import lru_cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import integrate, optimize, stats

from lusee_bayes.core.arrays import on_device
from lusee_bayes.core.errors import InputError
from lusee_bayes.linear.information import Information
from lusee_bayes.sampling.log_normal.gauss_newton import LogNormalMode, find_mode
from lusee_bayes.sampling.log_normal.learning import learn_spectrum
from lusee_bayes.sampling.log_normal.posterior import LogNormalPosterior
from lusee_bayes.sampling.log_normal.prior import AMPLITUDE, STRUCTURE, TILT, LogNormalPrior
from lusee_bayes.sampling.log_normal.straight import straight_coordinates
from lusee_bayes.sky import BRIGHT_SOURCES
from lusee_bayes.sky.log_normal import LogNormalSky, deviation_spectrum
from lusee_bayes.sky.priors import DensePrior
from lusee_bayes.sky.template import EmbeddedTemplate

MHZ, LMAX, TILTED = 25.0, 3, -2.0
LEVEL = np.array([4.0 * np.pi])


def log_normal(amplitude, lmax=LMAX, level=LEVEL, sources=()) -> LogNormalSky:
    spectrum = deviation_spectrum(lmax, amplitude, TILTED, level)
    return LogNormalSky.of(EmbeddedTemplate(MHZ), spectrum, MHZ, sources, band=16)


def informed(truth: np.ndarray) -> Information:
    """What data say that know combinations of 16 modes to 10 to 1e5 K; the template's is 1e5 K."""
    rng = np.random.default_rng(1)
    rotation = np.linalg.qr(rng.standard_normal((16, 16)))[0]
    precision = np.geomspace(1e-2, 1e-10, 16)
    return Information(
        (rotation * precision) @ rotation.T,
        rotation @ (np.sqrt(precision) * rng.standard_normal(16)),
        truth,
        np.asarray(96.0),
        np.asarray(0.0),
        np.asarray(96.0),
    )


@lru_cache
def information(amplitude: float = 0.03) -> Information:
    """Of a sky that departs from the template by 10 % on large scales."""
    sky = log_normal(amplitude, sources=BRIGHT_SOURCES[:1])
    return informed(sky.modes(np.random.default_rng(2).standard_normal(sky.size)))


@lru_cache
def mode() -> LogNormalMode:
    return find_mode(log_normal(0.03, sources=BRIGHT_SOURCES[:1]), information())


# --- against quadrature: one mode of the map, one source --------------------------------------


@pytest.fixture(scope="module")
def two_unknowns():
    """A datum of the mean temperature, half as large again as the template's, known to 5 %."""
    sky = log_normal(0.1, lmax=0, sources=BRIGHT_SOURCES[:1])
    value = 1.5 * sky.modes(np.zeros(2))
    precision = float((0.05 * value[0]) ** -2)
    given = Information(
        np.array([[precision]]),
        np.zeros(1),
        value,
        np.asarray(0.0),
        np.asarray(-np.log(precision)),
        np.asarray(1.0),
    )
    return sky, given


def integral(sky: LogNormalSky, given: Information, weight) -> float:
    """int p(u) p(d | u) weight(u) du on a fine grid: the trapezoidal rule of a smooth density."""
    x = np.linspace(-7.0, 7.0, 1501)
    u = np.stack(np.meshgrid(x, x, indexing="ij"), axis=-1).reshape(-1, 2)
    off = sky.modes(np.zeros(2))[0] * 0.0 + np.exp(u[:, 0]) * sky.modes(np.array([0.0, -40.0]))[0]
    off = off + stats.expon.isf(stats.norm.sf(u[:, 1])) * sky.source_modes[0, 0]
    off = off - given.reference[0]
    log_density = -0.5 * (given.matrix[0, 0] * off**2 + (u**2).sum(1) + given.log_det)
    density = np.exp(log_density) * (2.0 * np.pi) ** -1.5 * weight(u)
    return float(integrate.trapezoid(integrate.trapezoid(density.reshape(1501, 1501), x), x))


def test_draws_have_the_moments_and_the_evidence_of_quadrature(two_unknowns):
    sky, given = two_unknowns
    posterior = LogNormalPosterior.about(find_mode(sky, given))
    draws = posterior.sample(jax.random.key(0), 4000)
    evidence = integral(sky, given, lambda u: np.ones(len(u)))
    found = float(posterior.mode.log_evidence) + draws.evidence_gain
    assert draws.evidence_error < 0.02
    assert abs(found - np.log(evidence)) < 5.0 * draws.evidence_error
    # Laplace's formula alone is off by more: the test can tell
    assert abs(float(posterior.mode.log_evidence) - np.log(evidence)) > 5.0 * draws.evidence_error
    for k in (0, 1):
        mean = integral(sky, given, lambda u, k=k: u[:, k]) / evidence
        square = integral(sky, given, lambda u, k=k: u[:, k] ** 2) / evidence
        error = np.sqrt((square - mean**2) / draws.effective)
        drawn = (draws.weights * draws.white[:, k]).mean()
        assert abs(drawn - mean) < 5.0 * error
        drawn = (draws.weights * draws.white[:, k] ** 2).mean()
        assert abs(drawn - square) < 5.0 * np.sqrt(2.0) * square / np.sqrt(draws.effective)


def test_the_mode_is_where_a_search_without_derivatives_finds_it(two_unknowns):
    sky, given = two_unknowns

    def energy(u):
        return float(given.chi2(sky.modes(u))) + u @ u

    best = optimize.minimize(energy, np.zeros(2), method="Nelder-Mead", tol=1e-10)
    np.testing.assert_allclose(find_mode(sky, given).white, best.x, atol=1e-4)


# --- against closed forms ---------------------------------------------------------------------


def test_small_deviations_have_the_posterior_of_a_gaussian_sky():
    """s of 1e-4: exp(s) - 1 - s is 1e-8, of skies that the data know to 1e-5."""
    sky = log_normal(1e-4, level=np.array([1e-8]))
    root = sky.jacobian(np.zeros(sky.size))
    prior = DensePrior.of_covariance(root @ root.T, sky.modes(np.zeros(sky.size)))
    given = informed(sky.modes(np.random.default_rng(0).standard_normal(sky.size)))
    expected = given.posterior(prior)
    found = LogNormalPosterior.about(find_mode(sky, given))
    assert float(found.mode.log_evidence) == pytest.approx(float(expected.log_evidence), abs=0.02)
    std = np.asarray(expected.std())
    assert np.abs((found.mode.modes - np.asarray(expected.mean)) / std).max() < 0.02
    np.testing.assert_allclose(np.sqrt(np.diag(found.covariance())), std, rtol=1e-3)
    draws = found.sample(jax.random.key(0), 20)
    assert draws.log_weights.std() < 0.02


def test_the_gradient_vanishes_at_the_mode():
    found = mode()
    sky, given = on_device((found.sky, found.information))

    def energy(u):
        return 0.5 * (given.chi2(sky.modes(u)) + u @ u)

    slope = np.asarray(jax.jit(jax.grad(energy))(jnp.asarray(found.white)))
    # H^-1 measures it in standard deviations
    assert np.linalg.norm(np.linalg.solve(found.lower, slope)) < 1e-3


# --- straight coordinates ---------------------------------------------------------------------


@pytest.mark.parametrize("learned", [False, True])
def test_straight_coordinates_are_one_to_one_with_the_determinant_they_say(learned):
    power_law = (np.log(0.03), TILTED) if learned else None
    covariance = np.array([[0.04, 0.01], [0.01, 0.09]]) if learned else None
    coordinates = straight_coordinates(mode(), power_law, covariance)
    n = coordinates.root.shape[0]
    z = jax.random.normal(jax.random.key(3), (n,), dtype=jnp.float64)
    x = coordinates.mean + coordinates.root @ z

    @jax.jit
    def flat(x):
        values, log_det = coordinates.to_values(x)
        return coordinates.join(values), log_det

    values, log_det = flat(x)
    assert float(jnp.abs(values - x).max()) > 1e-3
    back = jax.jit(lambda values: coordinates.from_values(coordinates.split(values)))(values)
    np.testing.assert_allclose(back, x, rtol=0, atol=1e-11)
    derivative = jax.jit(jax.jacfwd(lambda x: flat(x)[0]))(x)
    # rounding errors of 1e-16 times a condition of 1e5
    assert float(log_det) == pytest.approx(np.linalg.slogdet(derivative)[1], abs=1e-8)
    assert (float(log_det) != 0.0) == learned


def test_energies_are_those_of_a_gaussian_in_straight_coordinates_only():
    posterior = LogNormalPosterior.about(mode())
    draws = posterior.sample(jax.random.key(0), 60)
    assert draws.log_weights.std() < 1.0
    assert draws.effective > 25
    # what a Gaussian about the mode would draw contradicts the data
    bent = posterior.mode.white[None] + draws.linear
    given = posterior.mode.information
    chi2 = np.array([float(given.chi2(m)) for m in posterior.mode.sky.modes(bent)])
    straight = np.array([float(given.chi2(m)) for m in draws.skies])
    # chi^2 of 96 data scatters by 14
    assert np.median(chi2 - straight) > 100.0


def test_weighted_draws_have_the_moments_of_many():
    """Means and standard deviations of the modes, from 400 draws and from 2000."""
    posterior = LogNormalPosterior.about(mode())
    few, many = (posterior.sample(jax.random.key(k), n) for k, n in ((0, 400), (1, 2000)))
    expected, std = many.mean(many.skies), np.sqrt(many.variance(many.skies))
    error = np.sqrt(1.0 / few.effective + 1.0 / many.effective)
    assert np.abs((few.mean(few.skies) - expected) / std).max() < 4.0 * error
    assert np.abs(posterior.std(few) / std - 1.0).max() < 4.0 * error
    equal = few.resampled(few.skies, jax.random.key(2), 100)
    assert np.abs((equal.mean(0) - expected) / std).max() < 5.0 * np.sqrt(0.01 + error**2)
    # without weights they are not
    assert np.abs((few.skies.mean(0) - expected) / std).max() > 4.0 * error


# --- C_ell that is learned --------------------------------------------------------------------


def test_the_learned_spectrum_has_the_highest_evidence_and_its_curvature():
    prior = LogNormalPrior.of(log_normal(0.02), 0.02, TILTED, (0.7, 0.5))
    found = learn_spectrum(prior, information())
    best = np.array([np.log(found.prior.amplitude), found.prior.tilt])
    centre, std = np.array([np.log(0.02), TILTED]), np.array([0.7, 0.5])

    def log_posterior(theta):
        sky = prior.sky.with_power_law(np.exp(theta[0]), theta[1])
        of_data = float(find_mode(sky, information()).log_evidence)
        return of_data - 0.5 * (((theta - centre) / std) ** 2).sum()

    top = log_posterior(best)
    for direction in np.linalg.cholesky(found.covariance).T:
        up, down = log_posterior(best + direction), log_posterior(best - direction)
        # a parabola with this covariance falls by 1/2 on both sides
        assert 0.5 * (up + down) - top == pytest.approx(-0.5, abs=0.1)
        assert 0.5 * (up - down) == pytest.approx(0.0, abs=0.1)
    assert not found.prior.is_learned


# --- refusals ---------------------------------------------------------------------------------


def test_refusals():
    with pytest.raises(InputError, match="the information has shape"):
        find_mode(log_normal(0.1, lmax=2), information())
    with pytest.raises(InputError, match="come in pairs, got 3"):
        LogNormalPosterior.about(mode()).sample(jax.random.key(0), 3)
    with pytest.raises(InputError, match="are known; give the standard deviations"):
        learn_spectrum(LogNormalPrior.of(log_normal(0.1), 0.1, TILTED), information())
    with pytest.raises(InputError, match="amplitude of the logarithm of the sky must be positive"):
        LogNormalPrior.of(log_normal(0.1), 0.0, TILTED)
    with pytest.raises(InputError, match="standard deviation of the tilt must be positive"):
        LogNormalPrior.of(log_normal(0.1), 0.1, TILTED, (1.0, 0.0))


def test_names_of_sites_are_those_of_the_coordinates():
    coordinates = straight_coordinates(mode(), (np.log(0.03), TILTED), np.eye(2))
    assert coordinates.names == (AMPLITUDE, TILT, STRUCTURE)
    assert coordinates.chart.names == (STRUCTURE, AMPLITUDE, TILT)
