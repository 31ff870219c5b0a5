"""What data say of the sky: sums for data in parts, and likelihoods of skies."""

from dataclasses import replace
from operator import add

import jax.numpy as jnp
import numpy as np
import pytest
from assertions import assert_same_map, refuse
from experiments import of_run
from reference_linear import posterior, random_covariance
from scipy import linalg, stats

import lusee_bayes as lb
from lusee_bayes.experiment.model import full_model
from lusee_bayes.instrument.coupling import DenseCoupling
from lusee_bayes.linear.linear_gaussian import InData
from lusee_bayes.noise.covariance import DenseCovariance
from lusee_bayes.sky.prior import DensePrior
from lusee_bayes.systematics.context import Around

N = 9
SPECTRUM = np.array([4.0, 1.0, 0.25])
# numbers of order one, condition below 1e3
TOL = 1e-10


def random_parts():
    """Models of two data sets of one sky, whose noise has no structure, and their data."""
    rng, prior = np.random.default_rng(4), lb.HarmonicPrior(jnp.asarray(SPECTRUM))
    models, data = [], []
    for n in (20, 7):
        noise = DenseCovariance(jnp.asarray(random_covariance(rng, n)))
        a, offset = (jnp.asarray(rng.normal(size=size)) for size in ((n, N), n))
        models.append(lb.LinearGaussian(a, prior, noise, offset))
        data.append(jnp.asarray(3.0 * rng.normal(size=n)))
    return models, data


def test_likelihoods_and_sums_are_those_of_matrices():
    models, data = random_parts()
    skies = np.random.default_rng(5).normal(size=(6, N))
    parts = [model.condition(d).information for model, d in zip(models, data, strict=True)]
    expected = []
    for m, d in zip(models, data, strict=True):
        left = np.asarray(d) - np.array([m.predict(sky) for sky in skies])
        expected.append(stats.multivariate_normal(np.zeros(m.n_data), m.noise.dense()).logpdf(left))
    for part, likelihoods in zip(parts, expected, strict=True):
        np.testing.assert_allclose(part.log_likelihood(skies), likelihoods, rtol=TOL)
    # whichever is first
    for total in (parts[0] + parts[1], parts[1] + parts[0]):
        np.testing.assert_allclose(total.log_likelihood(skies), sum(expected), rtol=TOL)
        assert float(total.n_data) == 27


# none of them is that of the data's models; one knows an ell to be zero
PRIORS = {
    "half": lambda: lb.HarmonicPrior(jnp.asarray(0.5 * SPECTRUM)),
    "zero": lambda: lb.HarmonicPrior(jnp.asarray([4.0, 0.0, 0.5])),
    "correlated": lambda: DensePrior(
        np.linalg.cholesky(random_covariance(np.random.default_rng(6), N)),
        mean=np.linspace(-1.0, 2.0, N),
    ),
}


@pytest.mark.parametrize("kind", PRIORS)
def test_the_posterior_of_a_sum_is_that_of_all_data(kind):
    models, data = random_parts()
    solutions = [model.condition(d) for model, d in zip(models, data, strict=True)]
    total = solutions[1].information + solutions[0].information
    a = np.concatenate([np.asarray(model.coupling.dense()) for model in models])
    noise = linalg.block_diag(*(np.asarray(model.noise.dense()) for model in models))
    offset = np.concatenate([np.asarray(model.offset) for model in models])
    every, prior = np.concatenate([np.asarray(d) for d in data]), PRIORS[kind]()
    mean = np.zeros(N) if prior.mean is None else np.asarray(prior.mean)
    answer = posterior(a, prior.covariance(), noise, every, offset + a @ mean)
    found = total.posterior(prior)
    np.testing.assert_allclose(found.mean, answer.mean + mean, atol=TOL)
    np.testing.assert_allclose(found.covariance(), answer.covariance, atol=TOL)
    np.testing.assert_allclose(found.log_evidence, answer.log_prob, rtol=TOL)
    residual = every - offset - a @ (answer.mean + mean)
    told = total.fit(np.asarray(found.mean), np.asarray(found.covariance()))
    assert told["chi2"] == pytest.approx(residual @ np.linalg.solve(noise, residual), rel=TOL)
    for solution in solutions:
        under, alone = solution.under(prior).posterior, solution.information.posterior(prior)
        np.testing.assert_allclose(under.mean, alone.mean, atol=TOL)
        np.testing.assert_allclose(under.log_evidence, alone.log_evidence, rtol=TOL)
    seen = a.T @ np.linalg.solve(noise, a)
    assert told["chi2_expected"] == pytest.approx(27 - np.vdot(seen, answer.covariance), rel=TOL)


def test_information_about_other_modes_is_not_added():
    models, data = random_parts()
    whole = models[0].condition(data[0]).information
    coupling = DenseCoupling(models[0].coupling.dense()[:, :4])
    prior = lb.HarmonicPrior(jnp.asarray(SPECTRUM[:2]))
    few = replace(models[0], coupling=coupling, prior=prior).condition(data[0]).information
    refuse("the other data.*lmax", add, whole, few)
    refuse("prior.*same modes", whole.posterior, prior)


@pytest.mark.long
def test_a_second_cycle_at_full_size(exact_tilt):
    # N of the parts is that of the whole: about the model, and not about each one's data
    scenario = lb.load_scenario("two_cycles", ["noise.radiometer.temperature=model"])
    experiment = lb.build(scenario)
    data, parts = experiment.data, [of_run(experiment.data, run) for run in (0, 1)]
    models = [full_model(lb.build(scenario, part).setup, Around(part)) for part in parts]
    whole = full_model(experiment.setup, Around(data))
    each = zip(models, parts, strict=True)
    first, second = (model.condition(part.data).information for model, part in each)
    got = (second + first).posterior(whole.prior)
    expected = whole.condition(data.data, InData).posterior
    # the mean's last step may be 1e-6 standard deviations, and the gradient of the earlier data at
    # the mean of the later ones is a small difference; variances lose 1e-6 (Posterior)
    assert_same_map(got, expected, 1e-5)
    assert abs(float(got.log_evidence - expected.log_evidence)) < 1e-3
    # the second cycle did say something
    assert (np.abs(first.posterior(whole.prior).mean - expected.mean) / expected.std()).max() > 0.5
