"""A prior with a mean: m = mu + deviation, so that all is textbook algebra of d - A mu."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from reference_linear import assert_draws_follow, posterior
from scipy.stats import multivariate_normal

from lusee_bayes.core.errors import InputError
from lusee_bayes.experiment.model import base_model
from lusee_bayes.instrument.coupling import DenseCoupling
from lusee_bayes.judge.residuals import residuals
from lusee_bayes.linear.model import LinearGaussian, updated
from lusee_bayes.noise.covariance import DiagonalCovariance
from lusee_bayes.noise.instrument_errors import beam_error_noise
from lusee_bayes.sampling.distributions import Marginal, SkyPrior
from lusee_bayes.sky.prior import HarmonicPrior

SPECTRUM = np.array([4.0, 1.0, 0.5, 0.25])
PER_MODE = np.repeat(SPECTRUM, [1, 3, 5, 7])
RNG = np.random.default_rng(5)
A = RNG.normal(size=(24, 16))
VARIANCE = RNG.uniform(0.1, 0.3, 24)
MEAN = 3.0 * RNG.normal(size=16)
OFFSET = RNG.normal(size=24)
DATA = A @ (MEAN + np.sqrt(PER_MODE) * RNG.normal(size=16)) + OFFSET + 0.4 * RNG.normal(size=24)
# condition numbers below 1e4 x 24 data x eps
CLOSE = 1e-10


def model(rows=slice(None)) -> LinearGaussian:
    return LinearGaussian(
        jnp.asarray(A[rows]),
        HarmonicPrior(jnp.asarray(SPECTRUM), mean=jnp.asarray(MEAN)),
        DiagonalCovariance(jnp.asarray(VARIANCE[rows])),
        jnp.asarray(OFFSET[rows]),
    )


def expected(rows=slice(None)):
    answer = posterior(
        A[rows], np.diag(PER_MODE), np.diag(VARIANCE[rows]), (DATA - OFFSET - A @ MEAN)[rows]
    )
    return answer._replace(mean=answer.mean + MEAN)


@pytest.mark.parametrize("form", ["map", "data", "root", "structured"])
def test_every_form_gives_the_textbooks_posterior(form):
    found, answer = model().condition(jnp.asarray(DATA), form), expected()
    np.testing.assert_allclose(found.mean, answer.mean, atol=CLOSE)
    np.testing.assert_allclose(found.std(), answer.std, rtol=CLOSE)
    np.testing.assert_allclose(found.log_evidence, answer.log_prob, rtol=CLOSE)


def test_chi2_is_of_the_deviation_from_the_prior():
    """(d - A mu)^T (A S A^T + N)^-1 (d - A mu), with a solver that knows no prior."""
    found = model().condition(jnp.asarray(DATA))
    centred = DATA - OFFSET - A @ MEAN
    direct = centred @ np.linalg.solve(A * PER_MODE @ A.T + np.diag(VARIANCE), centred)
    told = model().chi2(found.mean, jnp.asarray(DATA)) + found.prior_chi2()
    np.testing.assert_allclose(told, direct, rtol=CLOSE)


def test_a_posterior_is_not_updated_under_another_mean():
    earlier = model().condition(jnp.asarray(DATA), "root")
    for mean in (None, jnp.asarray(MEAN + 1e-6)):
        other = replace(model(), prior=HarmonicPrior(jnp.asarray(SPECTRUM), mean=mean))
        with pytest.raises(InputError, match="another mean"):
            updated(earlier, other, jnp.asarray(DATA))


def test_updates_information_and_few_data():
    first, rest = slice(0, 18), slice(18, 24)
    earlier = model(first).condition(jnp.asarray(DATA[first]), "root")
    found = updated(earlier, model(rest), jnp.asarray(DATA[rest]))
    np.testing.assert_allclose(found.mean, expected().mean, atol=CLOSE)
    np.testing.assert_allclose(found.log_evidence, expected().log_prob, rtol=CLOSE)
    few = model(rest).condition(jnp.asarray(DATA[rest]))
    assert few.basis is not None
    np.testing.assert_allclose(few.mean, expected(rest).mean, atol=CLOSE)
    # information knows no prior: with another one it gives that one's posterior
    information, _ = model().inform(jnp.asarray(DATA))
    without = replace(model(), prior=HarmonicPrior(jnp.asarray(SPECTRUM)))
    np.testing.assert_allclose(
        information.posterior(without.prior).mean,
        without.condition(jnp.asarray(DATA)).mean,
        atol=CLOSE,
    )


def test_draws_and_densities():
    prior = model().prior
    assert_draws_follow(prior.sample(jax.random.key(0), 4000), MEAN, np.diag(PER_MODE))
    sky = MEAN + RNG.normal(size=16)
    np.testing.assert_allclose(
        SkyPrior(prior).log_prob(jnp.asarray(sky)),
        multivariate_normal.logpdf(sky, MEAN, np.diag(PER_MODE)),
        rtol=1e-12,
    )
    draws = SkyPrior(prior).sample(jax.random.key(1), (2, 3))
    assert draws.shape == (2, 3, 16)
    # ln p(d_i | the others) = ln p(d) - ln p(the others)
    left_out = Marginal(model()).leave_one_out(jnp.asarray(DATA))
    others = np.arange(24) != 7
    np.testing.assert_allclose(
        left_out[7], expected().log_prob - expected(others).log_prob, rtol=1e-8
    )


def test_a_beam_error_holds_the_mean_sky():
    direction = RNG.normal(size=(24, 16))
    found = beam_error_noise(DenseCoupling(jnp.asarray(direction)), model().prior).dense()
    second_moment = np.diag(PER_MODE) + np.outer(MEAN, MEAN)
    np.testing.assert_allclose(found, direction @ second_moment @ direction.T, atol=1e-10)


def test_residuals_are_those_of_the_data_less_the_mean(small_experiment):
    """The same posterior and the same verdicts as of d - A mu with a prior about zero."""
    setup, data = small_experiment.setup, small_experiment.data
    mean = 0.5 * np.asarray(setup.sky.modes)
    about_zero = base_model(setup)
    about_mean = replace(about_zero, prior=HarmonicPrior(setup.prior.spectrum, mean=mean))
    less = replace(data, data=data.data - np.asarray(setup.coupling @ mean))
    one, other = about_mean.condition(data.data), about_zero.condition(less.data)
    sigma = np.asarray(one.std())
    # both means are refined to 1e-6 sigma
    assert np.abs((one.mean - mean - other.mean) / sigma).max() < 1e-5
    first, second = (
        residuals(model, p, d, float(model.chi2(p.mean, d.data) + p.prior_chi2()))
        for model, p, d in ((about_mean, one, data), (about_zero, other, less))
    )
    for part in ("instrument", "prior"):
        a, b = getattr(first.split, part), getattr(second.split, part)
        np.testing.assert_allclose([a.chi2, a.degrees], [b.chi2, b.degrees], rtol=1e-5)
    for a, b in zip(first.days + first.products, second.days + second.products, strict=True):
        np.testing.assert_allclose(a.chi2, b.chi2, rtol=1e-5)


def test_a_mean_that_the_spectrum_excludes_is_refused():
    with pytest.raises(InputError, match="power at ell = 2, where C_ell is zero"):
        HarmonicPrior(jnp.array([1.0, 1.0, 0.0, 1.0]), mean=jnp.asarray(MEAN))
    with pytest.raises(InputError, match="the prior mean has shape"):
        HarmonicPrior(jnp.asarray(SPECTRUM[:3]), mean=jnp.asarray(MEAN))
