"""A whole map under a prior that correlates modes: results, and its resolution."""

from dataclasses import replace

import numpy as np
import pytest
from experiments import mapped
from reference_linear import matrices, random_covariance

import lusee_bayes as lb
from lusee_bayes.core.harmonics import mode_numbers
from lusee_bayes.linear.posterior import pixel_std
from lusee_bayes.results.channel_map import region_rows
from lusee_bayes.testing.scenarios import small_scenario

LMAX = 6


def with_dense_prior(experiment: lb.Experiment) -> lb.Experiment:
    width = np.sqrt(np.asarray(experiment.setup.prior.variance()))
    rng = np.random.default_rng(0)
    covariance = random_covariance(rng, len(width)) * width * width[:, None]
    prior = lb.DensePrior.of_covariance(covariance, 0.2 * width * rng.normal(size=len(width)))
    return replace(experiment, setup=replace(experiment.setup, prior=prior))


@pytest.fixture(scope="module")
def found():
    """The experiment conditioned on its data, and the channel."""
    scenario = small_scenario(lmax=LMAX, cycles=0.1)
    return mapped(with_dense_prior(lb.build(scenario)))


def test_the_channel_is_that_of_matrices(found):
    made, channel = found
    model, data = made.own.model, np.asarray(made.experiment.data.data)
    (a, s, n), mean = matrices(model), np.asarray(model.prior.mean)
    covariance = np.asarray(made.found.posterior.covariance())
    # chi^2 of residuals: N_data less what the sky takes, tr(A C A^T N^-1)
    taken = np.trace(np.linalg.solve(n, a @ covariance @ a.T))
    np.testing.assert_allclose(channel.chi2_expected, len(data) - taken, rtol=1e-6)
    np.testing.assert_allclose(channel.prior_std, np.sqrt(np.diag(s)), rtol=1e-12)
    centred = data - a @ mean
    centred = centred if model.offset is None else centred - np.asarray(model.offset)
    k = a @ s @ a.T + n
    # K spans ten orders of magnitude
    total = centred @ np.linalg.solve(k, centred)
    np.testing.assert_allclose(channel.chi2_model, total, rtol=1e-4)
    parts = channel.instrument.chi2 + channel.judged.prior.chi2
    np.testing.assert_allclose(parts, channel.chi2_model, rtol=1e-6)
    # shares of the prior, the monopole taken for known
    rest, left = s.copy(), covariance.copy()
    for matrix in (rest, left):
        matrix[0] = matrix[:, 0] = 0.0
    share = (pixel_std(left, channel.nside) / pixel_std(rest, channel.nside)) ** 2
    np.testing.assert_allclose(channel.details.prior_fraction, share, rtol=1e-8)
    rows = region_rows(channel.nside, LMAX)
    share = ((rows @ left) * rows).sum(1) / ((rows @ rest) * rows).sum(1)
    np.testing.assert_allclose(channel.details.region_prior_fraction, share, rtol=1e-8)


def test_its_resolution_is_packed(found):
    made, channel = found
    details = channel.details
    width = details.prior_width
    ell, _ = mode_numbers(LMAX)
    steps = details.resolution_step[np.ix_(ell, ell)]
    scale = width[:, None] / width[None]
    found = details.resolution * steps * scale
    s = np.asarray(made.own.model.prior.covariance())
    covariance = np.asarray(made.found.posterior.covariance())
    exact = np.eye(len(s)) - covariance @ np.linalg.inv(s)
    assert (np.abs(found - exact) <= 0.51 * steps * scale).all()
