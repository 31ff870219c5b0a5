"""Parameters in normal scores, and the evidence with them integrated out."""

from __future__ import annotations

import jax
import numpy as np
import pytest
from scipy import stats

import lusee_bayes as lb
from lusee_bayes.priors.families import FREEDOM, Hyperprior, IsotropicFamily
from lusee_bayes.priors.learning import learn

LMAX, N_DATA, NOISE = 4, 40, 2000.0


def information_of(family, seed=3):
    """Of data of a sky of the family, through a random A."""
    rng = np.random.default_rng(seed)
    prior = family.prior(family.at(family.hyperprior.start()).covariance)
    sky = np.asarray(prior.sample(jax.random.key(4)))
    coupling = rng.standard_normal((N_DATA, len(sky))) / 3.0
    noise = lb.DiagonalCovariance(np.full(N_DATA, NOISE**2))
    model = lb.LinearGaussian(coupling, lb.HarmonicPrior(np.full(LMAX + 1, 1e8)), noise)
    return model.condition(coupling @ sky + NOISE * rng.standard_normal(N_DATA)).information


@pytest.mark.long
def test_the_evidence_agrees_with_draws_of_the_hyperprior():
    """The mean of p(d | theta) over theta ~ p(theta), which no maximum enters."""
    family = IsotropicFamily.around(2e4, LMAX)
    information = information_of(family)
    hyperprior, rng = family.hyperprior, np.random.default_rng(5)
    size = (1000, hyperprior.size)
    drawn = hyperprior.centre + hyperprior.width * rng.standard_t(FREEDOM, size)
    values = []
    for theta in drawn:
        try:
            prior = family.prior(family.at(theta).covariance)
            values.append(float(information.posterior(prior).log_evidence))
        except lb.InputError:  # nothing of that size is in the data
            values.append(-np.inf)
    largest = max(values)
    expected = largest + np.log(np.exp(np.array(values) - largest).mean())
    # without the tails Laplace's approximation is 1.7 below
    assert abs(learn(family, information).log_evidence - expected) < 0.6


def test_scores_are_standard_normal_under_the_hyperprior():
    """Against SciPy's distributions: Student's, and a gamma distribution of a cell's power."""
    hyperprior = Hyperprior(np.array([1.0]), np.array([0.5]), n_cells=1)
    for score in np.linspace(-3.0, 3.0, 7):
        both, step = np.full(2, score), 1e-5
        found = hyperprior.of_scores(both)
        power = stats.gamma.isf(stats.norm.cdf(score), 0.75, scale=1.0 / 0.75)
        assert found[0] == pytest.approx(1.0 + 0.5 * stats.t.ppf(stats.norm.cdf(score), 2))
        assert found[1] == pytest.approx(-0.5 * np.log(power))
        np.testing.assert_allclose(hyperprior.scores(found), both, rtol=1e-10, atol=1e-12)
        rise = hyperprior.of_scores(both + step) - hyperprior.of_scores(both - step)
        np.testing.assert_allclose(
            hyperprior.slopes_of_scores(both), rise / (2.0 * step), rtol=1e-7
        )
