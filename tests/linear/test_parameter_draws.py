"""Draws with uncertain parameters of the prior, against integrals over the parameter."""

from __future__ import annotations

from dataclasses import dataclass

import jax
import numpy as np
import pytest
from scipy import integrate, stats

from lusee_bayes.core.arrays import on_host
from lusee_bayes.core.errors import InputError
from lusee_bayes.linear.information import Information
from lusee_bayes.linear.learning import Learned
from lusee_bayes.linear.model import LinearGaussian
from lusee_bayes.linear.parameter_draws import draws_with_parameters, information_behind
from lusee_bayes.noise.covariance import DiagonalCovariance
from lusee_bayes.sky.prior_family import IsotropicFamily
from lusee_bayes.sky.priors import DensePrior, HarmonicPrior

LMAX = 3
SIZE = (LMAX + 1) ** 2


# --- what data said, back from a posterior ----------------------------------------------------


@pytest.mark.parametrize("n_data", [40, 6], ids=["map-space form", "data-space form"])
@pytest.mark.parametrize("dense", [False, True], ids=["independent", "dense with a mean"])
def test_another_prior_gives_the_posterior_that_the_data_give(n_data, dense):
    rng = np.random.default_rng(3)
    prior = HarmonicPrior(np.geomspace(1e8, 1e6, LMAX + 1))
    if dense:
        root = 3e3 * rng.standard_normal((SIZE, SIZE))
        mean = 1e4 * rng.standard_normal(SIZE)
        prior = DensePrior.of_covariance(root @ root.T + 1e6 * np.eye(SIZE), mean)
    coupling = rng.standard_normal((n_data, SIZE))
    data = 1e4 * rng.standard_normal(n_data)
    noise = DiagonalCovariance(np.geomspace(1.0, 1e6, n_data))
    behind = information_behind(on_host(LinearGaussian(coupling, prior, noise).condition(data)))
    other = HarmonicPrior(np.full(LMAX + 1, 3e7))
    expected = LinearGaussian(coupling, other, noise).condition(data)
    found = behind.posterior(other)
    std = np.asarray(expected.std())
    # M is what is left of Lambda of up to 1e8 when 1 is taken off: 1e-8 of what the prior says
    assert np.abs((np.asarray(found.mean) - np.asarray(expected.mean)) / std).max() < 1e-5
    np.testing.assert_allclose(np.asarray(found.std()), std, rtol=1e-6)
    assert np.isnan(float(found.log_evidence))


# --- one parameter, the strength of the sky ---------------------------------------------------


@dataclass(frozen=True)
class Member:
    covariance: np.ndarray


SCALE = 1e3


class Strength(IsotropicFamily):
    """S = exp(theta) s^2 1."""

    def at(self, parameters):
        return Member(np.exp(parameters[0]) * SCALE**2 * np.eye(SIZE))

    def prior(self, covariance):
        return HarmonicPrior(np.diagonal(covariance)[np.arange(LMAX + 1) ** 2])


@pytest.fixture(scope="module")
def one_parameter():
    """Modes that are seen with noise from a tenth to ten times their strength; theta = 0.4 +- 1."""
    family, width = Strength.around(2e4, LMAX), 1.0
    noise = np.geomspace(0.1, 10.0, SIZE) * SCALE
    seen = 2.0 * SCALE * np.ones(SIZE)
    unknown = np.asarray(0.0)
    information = Information(
        np.diag(noise**-2.0), seen / noise**2, np.zeros(SIZE), unknown, unknown, unknown
    )
    prior = family.prior(family.at(np.array([0.4])).covariance)
    learned = Learned(prior, ("theta",), np.array([0.4]), np.array([[width**2]]), 0.0, 0)
    draws = draws_with_parameters(
        family, learned, information.posterior(prior), jax.random.key(1), 15000
    )
    return noise, seen, draws


def test_draws_are_those_of_the_integral_over_the_parameter(one_parameter):
    """Every mode: the distribution function at some points, by quadrature over theta."""
    noise, seen, draws = one_parameter
    assert draws.shape == (15000, SIZE)

    theta = np.linspace(-6.0, 7.0, 2001)
    density = stats.norm.pdf(theta, 0.4, 1.0)
    for k in (0, SIZE // 2, SIZE - 1):
        weight = 1.0 / (1.0 + noise[k] ** 2 / (np.exp(theta) * SCALE**2))
        for level in (0.02, 0.2, 0.5, 0.8, 0.98):
            at = np.quantile(draws[:, k], level)
            below = stats.norm.cdf(at, weight * seen[k], np.sqrt(weight) * noise[k])
            expected = integrate.simpson(below * density, x=theta)
            scatter = integrate.simpson((below - expected) ** 2 * density, x=theta)
            # 500 theta, each for 30 draws
            error = np.sqrt(scatter / 500 + level * (1 - level) / 15000)
            assert abs(level - expected) < 4.0 * error


def test_tails_are_those_of_uncertain_strength():
    """Modes that the data do not see: exp(theta) of N(0, 1/4) makes the kurtosis 3 exp(1/4)."""
    information = Information(
        1e-18 * np.eye(SIZE), np.zeros(SIZE), np.zeros(SIZE), *[np.asarray(0.0)] * 3
    )
    family = Strength.around(2e4, LMAX)
    prior = family.prior(family.at(np.zeros(1)).covariance)
    learned = Learned(prior, ("theta",), np.zeros(1), np.array([[0.25]]), 0.0, 0)
    posterior = information.posterior(prior)
    draws = draws_with_parameters(family, learned, posterior, jax.random.key(2), 15000)
    fourth = (draws**4).mean() / (draws**2).mean() ** 2
    # 500 theta: <exp(2 theta)> is known to 6 %, <exp(theta)>^2 to 5 %, both off alike
    assert fourth == pytest.approx(3.0 * np.exp(0.25), rel=0.15)
    plain = np.asarray(posterior.sample(jax.random.key(3), 15000))
    assert (plain**4).mean() / (plain**2).mean() ** 2 == pytest.approx(3.0, rel=0.05)
    # the first ten have parameters of their own
    sizes = draws[:10].std(1)
    assert sizes.max() / sizes.min() > 1.5


def test_few_draws_and_none():
    family = IsotropicFamily.around(2e4, LMAX)
    theta = family.hyperprior.start()
    prior = family.prior(family.at(theta).covariance)
    information = Information(
        np.eye(SIZE) * 1e-8, np.ones(SIZE), np.zeros(SIZE), *[np.ones(())] * 3
    )
    learned = Learned(prior, (), theta, 0.1 * np.eye(len(theta)), 0.0, 0)
    posterior = information.posterior(prior)
    drawn = [
        draws_with_parameters(family, learned, posterior, jax.random.key(1), n) for n in (0, 1, 7)
    ]
    assert [len(one) for one in drawn] == [0, 1, 7]
    assert len(np.unique(drawn[2], axis=0)) == 7


class Hopeless(Strength):
    """No theta has an S."""

    def prior(self, covariance):
        return DensePrior.of_covariance(-covariance)


def test_parameters_without_a_covariance_are_drawn_anew_and_then_refused():
    family = Strength.around(2e4, LMAX)
    prior = family.prior(family.at(np.zeros(1)).covariance)
    information = Information(
        np.eye(SIZE) * 1e-8, np.ones(SIZE), np.zeros(SIZE), *[np.ones(())] * 3
    )
    learned = Learned(prior, (), np.zeros(1), np.eye(1), 0.0, 0)
    posterior = information.posterior(prior)
    with pytest.raises(InputError, match="no sky can be drawn with the uncertainty of the prior's"):
        draws_with_parameters(Hopeless.around(2e4, LMAX), learned, posterior, jax.random.key(1), 3)
