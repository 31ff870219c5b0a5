"""Score tests of templates, against the covariance of the data as a matrix."""

import numpy as np
import pytest

import lusee_bayes as lb
from lusee_bayes.linear.offset_tests import preferences

N_DATA, LMAX, N = 60, 4, 5


@pytest.mark.parametrize("low_rank", [False, True])
def test_amplitudes_errors_and_gains(low_rank):
    rng = np.random.default_rng(8)
    a = rng.standard_normal((N_DATA, (LMAX + 1) ** 2))
    noise = lb.DiagonalCovariance(rng.uniform(0.5, 2.0, N_DATA))
    if low_rank:
        noise = noise + lb.LowRankCovariance(rng.standard_normal((N_DATA, 2)))
    prior = lb.HarmonicPrior(np.full(LMAX + 1, 4.0), mean=rng.standard_normal((LMAX + 1) ** 2))
    model = lb.LinearGaussian(lb.DenseCoupling(a), prior, noise, rng.standard_normal(N_DATA))
    data = 3.0 * rng.standard_normal(N_DATA)
    # the last one is a sky that the prior allows, but for a small part
    templates = rng.standard_normal((N_DATA, N))
    templates[:, -1] = a @ rng.standard_normal(a.shape[1]) + 0.01 * templates[:, -1]
    posterior = model.condition(data)
    got = preferences(model, posterior, np.asarray(posterior.covariance()), data, templates)
    k = a @ np.diag(np.asarray(prior.variance())) @ a.T + np.asarray(noise.dense())
    mean = np.asarray(model.predict(prior.colour(prior.white_mean)))
    inverse = np.linalg.inv(k)
    information = np.einsum("da,de,ea->a", templates, inverse, templates)
    pull = templates.T @ inverse @ (data - mean)
    np.testing.assert_allclose(got.std, information**-0.5, rtol=1e-9)
    np.testing.assert_allclose(got.amplitude, pull / information, rtol=1e-8)
    # chi^2 of the data without the best amount of each template
    for number in range(N):
        left = data - mean - got.amplitude[number] * templates[:, number]
        gain = (data - mean) @ inverse @ (data - mean) - left @ inverse @ left
        assert got.gain[number] == pytest.approx(gain, rel=1e-7)


def test_what_the_sky_takes_up_is_not_told():
    """A template that the prior's wide sky explains altogether: NaN, not a rounding error."""
    rng = np.random.default_rng(9)
    a = rng.standard_normal((N_DATA, (LMAX + 1) ** 2))
    prior = lb.HarmonicPrior(np.full(LMAX + 1, 1e14))
    model = lb.LinearGaussian(lb.DenseCoupling(a), prior, lb.DiagonalCovariance(np.ones(N_DATA)))
    data = rng.standard_normal(N_DATA)
    posterior = model.condition(data)
    template = a @ rng.standard_normal((a.shape[1], 1))
    got = preferences(model, posterior, np.asarray(posterior.covariance()), data, template)
    assert np.isnan(got.amplitude).all()
    assert np.isnan(got.std).all()
