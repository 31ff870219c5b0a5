"""Positive joint skies: mode and Gaussian against scipy and one big model of all channels."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from assertions import refuse
from reference import sphere
from scipy import optimize, stats

import lusee_bayes as lb
from lusee_bayes.core.harmonics import n_modes, per_mode, synthesis_matrix
from lusee_bayes.linear import positive_joint as pj
from lusee_bayes.linear.information import Information
from lusee_bayes.linear.joint import paired
from lusee_bayes.sky.positive_skies import LOG_WIDTH, TILT_WIDTH, FieldLaws, PositiveSkies

LMAX = 3
N = n_modes(LMAX)
FREQUENCIES = np.array([5.0, 9.0, 16.0, 30.0])


def band(frequency_mhz, theta, phi):
    """A bright band along the equator, so smooth that grids hold it."""
    scale = 100.0 * (frequency_mhz / 20.0) ** -2.5
    return scale * np.exp(-1.5 * np.cos(theta) ** 2 + 0.4 * np.sin(theta) * np.cos(phi))


def weight(theta, phi):
    return 0.6 + 0.3 * np.sin(theta) ** 2 + 0.1 * np.sin(theta) * np.sin(phi)


def skies_of(frequencies, names, n_sources=0):
    points = synthesis_matrix(np.array([0.4, 1.9]), np.array([2.0, 4.0]), LMAX)[:n_sources]
    sources = np.stack([20.0 * (f / 20.0) ** -2.5 * points for f in frequencies])
    templates = [partial(band, f) for f in frequencies]
    options = {"sources": sources, "weight": weight, "lmax_fields": LMAX, "band": 24}
    return PositiveSkies.of(frequencies, templates, LMAX, names, **options)


def quadrature():
    """Harmonics and weights on a grid of this file's own, far finer than the maps."""
    theta, phi, weights = sphere(40, 80)
    return theta, phi, synthesis_matrix(theta, phi, LMAX), weights


def drawn(prior, seed):
    first, second = jax.random.split(jax.random.key(seed))
    fields = prior.roots * jax.random.normal(first, prior.roots.shape, dtype=jnp.float64)
    std = np.sqrt(per_mode(prior.residual))
    residuals = std * jax.random.normal(second, std.shape, dtype=jnp.float64)
    return np.asarray(prior.mixing @ fields + residuals)


def observed(skies, laws, seed=0, noise=0.05, n_data=40, n_shared=0):
    """Skies drawn from the prior, seen by random couplings, beside what all channels share."""
    rng = np.random.default_rng(seed)
    found, shared = [], rng.standard_normal(n_shared)
    for k, exponent in enumerate(drawn(laws.prior(skies), seed)):
        fluxes = rng.exponential(size=skies.sources.shape[1])
        sky = skies.modes(k, exponent) + fluxes @ skies.sources[k]
        a = rng.standard_normal((n_data + 2 * k, N))
        sigma = noise * np.sqrt((a @ sky) ** 2).mean() * rng.uniform(0.5, 2.0, len(a))
        d = a @ sky + sigma * rng.standard_normal(len(a))
        information = information_of(a, sigma, d, (sky**2).max())
        if n_shared:
            t = np.sqrt(sigma**2).mean() * rng.standard_normal((len(a), n_shared))
            rows, at = np.concatenate([a, t], axis=1), np.append(information.reference, shared)
            d = d + t @ shared
            white, left = rows / sigma[:, None], (d - rows @ at) / sigma
            told = white.T @ white, white.T @ left, at, np.asarray(left @ left)
            information = Information(*told, information.log_det, information.n_data)
            a = rows
        found.append((a, sigma, d, information))
    return found


def information_of(a, sigma, d, wide):
    prior = lb.HarmonicPrior(jnp.full(LMAX + 1, wide))
    noise = lb.DiagonalCovariance(jnp.asarray(sigma**2))
    return lb.LinearGaussian(jnp.asarray(a), prior, noise).condition(jnp.asarray(d)).information


def rough(skies, level=0.3):
    """Laws of fields that are as strong as the templates, so that nothing is linear."""
    laws = FieldLaws.of(skies)
    parameters = laws.parameters.copy()
    shares = np.where(np.arange(len(parameters)) < len(laws.means), 1, 0.3)
    parameters[:, 0] = np.log(level * shares)
    parameters[:, 1] = -1.0
    return replace(laws, parameters=parameters)


def test_the_mode_of_one_channel_is_that_of_a_direct_minimisation():
    skies = skies_of(FREQUENCIES[2:3], ("level",))
    laws = rough(skies)
    prior = laws.prior(skies)
    ((a, sigma, d, information),) = observed(skies, laws)
    theta, phi, y, weights = quadrature()
    template = band(16.0, theta, phi)
    root, rest = np.asarray(prior.roots)[0], np.asarray(prior.residual_root(0))

    def residuals(white):
        field = y @ (root * white[:N] + rest * white[N:])
        sky = y.T @ (weights * template * np.exp(weight(theta, phi) * field))
        return np.concatenate([(d - a @ sky) / sigma, white])

    direct = optimize.least_squares(residuals, np.zeros(2 * N), xtol=1e-15, ftol=1e-15, gtol=1e-12)
    mode = pj.find_joint_mode(skies, laws, pj.ChannelsInMemory((information,)))
    # what a last step of 0.1 sigma at most leaves: the curvature's own error times that step
    np.testing.assert_allclose(mode.energy, 2.0 * direct.cost, atol=0.1**2)
    np.testing.assert_allclose(mode.posterior.mean[:N] / root, direct.x[:N], atol=0.02)
    assert mode.rounds > 1  # the sky is not linear in its logarithm


@pytest.fixture(scope="module")
def case():
    """Four channels with sources that share two unknowns, and their mode."""
    skies = skies_of(FREQUENCIES, ("level", "index", "absorption"), n_sources=2)
    laws = rough(skies, 0.1)
    seen = observed(skies, laws, seed=3, n_shared=2)
    channels = pj.ChannelsInMemory(tuple(s[-1] for s in seen))
    return skies, laws, seen, pj.find_joint_mode(skies, laws, channels, np.zeros(2))


def test_the_gaussian_is_that_of_one_big_model(case):
    """All channels stacked: unknowns are fields, residuals, fluxes, and what channels share."""
    skies, _, seen, mode = case
    prior, fields = mode.prior, len(skies.names)
    theta, phi, y, weights = quadrature()
    n_sources = skies.sources.shape[1]
    size = fields * N + len(seen) * (N + n_sources) + 2
    to_skies, constants, wide = [], [], np.ones(size)
    wide[: fields * N] = np.asarray(prior.roots).ravel()
    strength = weight(theta, phi)
    for k in range(len(seen)):
        exponent = mode.exponents[k, :N]
        level = band(FREQUENCIES[k], theta, phi) * np.exp(strength * (y @ exponent))
        slope = y.T @ ((weights * strength * level)[:, None] * y)
        matrix = np.zeros((N + 2, size))
        matrix[N:, -2:] = np.eye(2)
        for c in range(fields):
            matrix[:N, c * N : (c + 1) * N] = prior.mixing[k, c] * slope
        at = fields * N + k * (N + n_sources)
        matrix[:N, at : at + N] = slope
        matrix[:N, at + N : at + N + n_sources] = skies.sources[k].T
        wide[at : at + N] = np.asarray(prior.residual_root(k))
        to_skies.append(matrix)
        at_zero = y.T @ (weights * level) - slope @ exponent
        constants.append(np.append(at_zero + skies.sources[k].sum(0), [0.0, 0.0]))
    a = np.concatenate([s[0] @ t for s, t in zip(seen, to_skies, strict=True)])
    offset = np.concatenate([s[0] @ c for s, c in zip(seen, constants, strict=True)])
    d, sigma = (np.concatenate([s[k] for s in seen]) for k in (2, 1))
    white = (a * wide) / sigma[:, None]
    inverse = np.linalg.inv(np.eye(size) + white.T @ white)
    mean = wide * (inverse @ (white.T @ ((d - offset) / sigma)))
    covariance = inverse * wide[:, None] * wide[None]

    evidence = stats.multivariate_normal(offset, (a * wide**2) @ a.T + np.diag(sigma**2)).logpdf(d)
    np.testing.assert_allclose(mode.posterior.log_evidence, evidence, rtol=1e-9)
    kept = [*range(fields * N), size - 2, size - 1]
    std = np.sqrt(np.diagonal(covariance))[kept]
    assert np.abs((mode.posterior.mean - mean[kept]) / std).max() < 1e-6
    # all four tell of what they share
    assert std[-1] < 0.2
    spread = paired(mode.posterior.covariance(), prior)
    none = np.zeros((0, fields * N + 2))
    for k, (s, t) in enumerate(zip(seen, to_skies, strict=True)):
        sky = pj.positive_sky(mode, k, s[-1], spread, none, jax.random.key(0))
        expected = t @ covariance @ t.T
        width = np.sqrt(np.diagonal(expected))
        assert np.abs((sky.covariance - expected) / np.outer(width, width)).max() < 1e-6
        # the exponential of the last step is linear but for its square
        assert np.abs((sky.mean - constants[k] - t @ mean) / width).max() < 0.02


def test_draws_scatter_as_the_covariance_says_and_are_positive(case):
    skies, _, seen, mode = case
    draws = np.asarray(mode.posterior.sample(jax.random.key(1), 3000))
    spread = paired(mode.posterior.covariance(), mode.prior)
    sky = pj.positive_sky(mode, 0, seen[0][-1], spread, draws, jax.random.key(2))
    width = np.sqrt(np.diagonal(sky.covariance))
    # standard deviations of 3000 draws scatter by 1.3 %, the exponential adds some percent
    np.testing.assert_allclose(sky.draws.std(0) / width, 1.0, atol=0.15)
    # not in what the data know best
    white = np.linalg.solve(np.linalg.cholesky(sky.covariance), (sky.draws - sky.mean).T)
    assert (white**2).mean() == pytest.approx(1.0, abs=0.15)
    assert (skies.values(0, mode.exponents[0, :N]) > 0).all()


def test_far_templates_are_reached_in_shorter_steps():
    """Data of a sky twenty times the template: the first full step would overshoot by far."""
    skies = skies_of(FREQUENCIES[:1], ("level",))
    laws = rough(skies)
    a, sigma, d, _ = observed(skies, laws)[0]
    far = information_of(a, sigma, 20.0 * d, 1e12)
    mode = pj.find_joint_mode(skies, laws, pj.ChannelsInMemory((far,)))
    assert np.exp(skies.grid.synthesise(mode.exponents[0])).mean() > 10.0


@pytest.mark.long
def test_learned_laws_maximise_the_evidence():
    skies = skies_of(FREQUENCIES, ("level", "index"))
    laws = rough(skies, 0.1)
    channels = pj.ChannelsInMemory(tuple(s[-1] for s in observed(skies, laws, seed=5, n_data=60)))
    found = pj.find_joint_mode(skies, FieldLaws.of(skies), channels, learn=True).laws

    def evidence(parameters):
        mode = pj.find_joint_mode(skies, replace(found, parameters=parameters), channels)
        away = (parameters - found.expected) / [LOG_WIDTH, TILT_WIDTH]
        return float(mode.posterior.log_evidence) - 0.5 * (away**2).sum()

    step = 0.3
    for law in range(len(found.parameters)):
        for which in range(2):
            moved = [found.parameters.copy() for _ in range(2)]
            moved[0][law, which] -= step
            moved[1][law, which] += step
            low, high = (evidence(p) for p in moved)
            here = evidence(found.parameters)
            # the vertex of the parabola lies within half of a standard deviation
            slope, bend = (high - low) / (2 * step), -(high + low - 2 * here) / step**2
            assert bend > 0 and abs(slope) < 0.5 * np.sqrt(bend)


def test_bad_input_is_refused_in_a_sentence():
    refuse("field 'indx'.*'index'", skies_of, FREQUENCIES, ("level", "indx"))
    refuse("2 fields.*channels", skies_of, FREQUENCIES[:1], ("level", "index"))
    options = {"sources": np.zeros((4, 0, N)), "weight": weight, "lmax_fields": LMAX}
    holes = [lambda theta, phi, f=f: band(f, theta, phi) - 50.0 for f in FREQUENCIES]
    refuse("the template", PositiveSkies.of, FREQUENCIES, holes, LMAX, **options)
    skies = skies_of(FREQUENCIES[:1], ("level",))
    other = Information(*(np.zeros(s) for s in ((4, 4), 4, 4, (), (), ())))
    refuse("the patterns", pj.linearised, skies, 0, other, np.zeros(N))
