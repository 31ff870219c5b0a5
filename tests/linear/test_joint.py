"""One posterior for several frequencies, against all data and skies as one big Gaussian."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from assertions import refuse, within
from reference_linear import posterior, z_of
from scipy.linalg import block_diag

import lusee_bayes as lb
from lusee_bayes.core.arrays import on_device, on_host
from lusee_bayes.linear import joint
from lusee_bayes.linear.joint_model import JointModel
from lusee_bayes.sky.spectral_prior import SpectralPrior

FREQUENCIES = np.array([10.0, 17.0, 25.0, 40.0])
LMAX, N_MODES = 2, 9


def skies(seed=0):
    """Power laws that bend, with a little of every channel's own; in K."""
    rng, x = np.random.default_rng(seed), np.log(FREQUENCIES / 20.0)[:, None]
    tilt = -2.5 + 0.2 * rng.standard_normal(N_MODES) + 0.3 * x * rng.standard_normal(N_MODES)
    own = 0.02 * rng.standard_normal((len(x), N_MODES))
    return 100.0 * rng.standard_normal(N_MODES) * np.exp(tilt * x) * (1.0 + own)


components = SpectralPrior.components
PRIORS = {
    "components": lambda: components(FREQUENCIES, skies(), ("power_law", "turnover")),
    "other rest": lambda: components(FREQUENCIES, skies(), residual=0.05),
    "no rest": lambda: components(FREQUENCIES, skies(), residual=0.0),
}


def covariance_of(prior):
    """S of all channels' skies, channel by channel, from the definition."""
    n, components = len(FREQUENCIES) * N_MODES, np.asarray(prior.spectra)
    ell, s = np.repeat(np.arange(LMAX + 1), 2 * np.arange(LMAX + 1) + 1), np.zeros((n, n))
    for column, spectrum in zip(np.asarray(prior.mixing).T, components, strict=True):
        s += np.kron(np.outer(column, column), np.diag(spectrum[ell]))
    if prior.residual is not None:
        s += np.diag(np.concatenate([r[ell] for r in np.asarray(prior.residual)]))
    return s


def models(prior, seed=4):
    """Channels with different numbers of data; noise ten times below the sky."""
    rng, made = np.random.default_rng(seed), []
    for k in range(len(FREQUENCIES)):
        n = 12 + 3 * k
        a = jnp.asarray(rng.standard_normal((n, N_MODES)))
        spectrum = prior.mixing[k] ** 2 @ prior.spectra
        if prior.residual is not None:
            spectrum = spectrum + prior.residual[k]
        own = lb.HarmonicPrior(spectrum)
        level = 0.1 * float(np.sqrt(np.asarray(own.variance()).mean()))
        noise = lb.DiagonalCovariance(jnp.asarray(level**2 * rng.uniform(0.5, 2.0, n)))
        made.append(lb.LinearGaussian(a, own, noise))
    return made


def big_gaussian(made):
    """A and N of all channels together."""
    a = block_diag(*(np.asarray(m.coupling.dense()) for m in made))
    return a, np.concatenate([np.asarray(m.noise.variance) for m in made])


def information_from(made, data):
    """Of every channel, and the reference skies."""
    channels = [m.condition(jnp.asarray(d)).information for m, d in zip(made, data, strict=True)]
    return channels, np.stack([np.asarray(t.reference) for t in channels])


def drawn(prior, made, seed=2):
    rng, s = np.random.default_rng(seed), covariance_of(prior)
    sky = np.linalg.cholesky(s + 1e-12 * np.diag(np.diag(s))) @ rng.standard_normal(len(s))
    sky, data = sky.reshape(len(made), N_MODES), []
    for model, own in zip(made, sky, strict=True):
        noise = np.sqrt(np.asarray(model.noise.variance)) * rng.standard_normal(model.n_data)
        data.append(np.asarray(model.coupling.dense()) @ own + noise)
    return data


def solve_directly(prior, channels, reference):
    sums = joint.ComponentSums.empty(prior, reference)
    for k, information in enumerate(channels):
        sums = joint.summed_information(sums, prior, k, information)
    return joint.component_posterior(sums.information(), prior)


EVERY = [
    "components",
    *(pytest.param(p, marks=pytest.mark.long) for p in ("other rest", "no rest")),
]


@pytest.fixture(scope="module", params=EVERY)
def case(request):
    """Prior, models and data, what they tell, and the textbook's answer."""
    prior = PRIORS[request.param]()
    made = models(prior)
    data = drawn(prior, made)
    a, n = big_gaussian(made)
    answer = posterior(a, covariance_of(prior), np.diag(n), np.concatenate(data))
    return prior, (made, data), *information_from(made, data), answer


@pytest.mark.essential
@pytest.mark.parametrize("place", [on_host, on_device])
def test_the_direct_solution_is_the_textbooks(case, place):
    """Of NumPy's arrays and of JAX's."""
    prior, _, channels, reference, (mean, covariance, evidence) = case
    found = solve_directly(place(prior), channels, reference)
    np.testing.assert_allclose(found.log_evidence, evidence, rtol=1e-8)
    std = np.sqrt(np.diag(covariance)).reshape(-1, N_MODES)
    maps, draws = found.mean, found.sample(jax.random.key(3), 4000)
    spread, slopes = joint.paired(found.covariance(), prior), []
    for k, information in enumerate(channels):
        rows = slice(k * N_MODES, (k + 1) * N_MODES)
        sky = joint.channel_sky(prior, k, information, maps, spread, draws, jax.random.key(5))
        slopes.append(joint.sky_slopes(prior, k, on_host(information), sky.lower, np.eye(N_MODES)))
        # the textbook's own subtraction of s leaves 1e-16 times (signal / noise)^2
        assert np.abs((np.asarray(sky.mean) - mean[rows]) / std[k]).max() < 1e-6
        within(sky.covariance, covariance[rows, rows], 1e-7 * std[k].max() ** 2)
        lower = np.linalg.cholesky(np.asarray(sky.covariance))
        z = np.linalg.solve(lower, (np.asarray(sky.draws) - np.asarray(sky.mean)).T)
        assert np.abs(z @ z.T / 4000 - np.eye(N_MODES)).max() < z_of(81) * np.sqrt(2 / 4000)
    # of two channels: what they have of the component maps
    seen = np.concatenate(slopes) @ np.asarray(found.root())
    others = np.kron(1.0 - np.eye(len(channels)), np.ones((N_MODES, N_MODES)))
    within(others * (seen @ seen.T), others * covariance, 1e-7 * std.max() ** 2)


@pytest.mark.essential
def test_channels_in_one_model_are_the_textbooks(case):
    """Evidence, its slope with the gain of one channel, and draws of all skies together."""
    prior, (made, data), *_, (mean, covariance, evidence) = case

    def with_gain(gain):
        scaled = [replace(made[0], coupling=made[0].coupling.dense() * gain)]
        return JointModel.of([*scaled, *made[1:]], [jnp.asarray(one) for one in data], prior)

    value, slope = jax.value_and_grad(lambda gain: with_gain(gain).log_prob())(1.0)
    np.testing.assert_allclose(value, evidence, rtol=1e-8)
    a, n = big_gaussian(made)
    rows, step = (np.arange(len(a)) < len(data[0]))[:, None], 1e-4
    moved = [a * (1.0 + sign * step * rows) for sign in (1.0, -1.0)]
    rest = covariance_of(prior), np.diag(n), np.concatenate(data)
    up, down = (posterior(matrix, *rest)[2] for matrix in moved)
    np.testing.assert_allclose(slope, (up - down) / (2.0 * step), rtol=1e-5)
    keys, variances = jax.random.split(jax.random.key(3), 4000), np.diag(covariance)
    off = np.asarray(jax.vmap(with_gain(1.0).sample)(keys)).reshape(4000, -1) - mean
    assert (np.abs(off.mean(0)) < z_of(len(mean)) * np.sqrt(variances / 4000)).all()
    scatter = np.sqrt((np.outer(variances, variances) + covariance**2) / 4000)
    assert (np.abs(off.T @ off / 4000 - covariance) < z_of(covariance.size) * scatter).all()


def test_skies_that_do_not_obey_the_prior_are_told():
    """Skies with a rest of their own, under a prior that has none: evidence and residuals fall."""
    true = components(FREQUENCIES, skies(), ("power_law",), residual=0.2)
    wrong = components(FREQUENCIES, skies(), ("power_law",), residual=1e-4)
    made, found = models(true), {}
    for name, obeys in (("obeyed", wrong), ("not obeyed", true)):
        data = drawn(obeys, made)
        channels, reference = information_from(made, data)
        for prior_name, prior in (("true", true), ("wrong", wrong)):
            solved = solve_directly(prior, channels, reference)
            maps, none = solved.mean, jnp.zeros((0, len(solved.mean)))
            spread, far = joint.paired(solved.covariance(), prior), []
            for k, t in enumerate(channels):
                sky = joint.channel_sky(prior, k, t, maps, spread, none, jax.random.key(0))
                fit = t.fit(sky.mean, sky.covariance)
                far.append((fit["chi2"] - fit["chi2_expected"]) / np.sqrt(2 * len(data[k])))
            found[name, prior_name] = float(solved.log_evidence), max(np.abs(far))
    # where the sky does have a rest, the prior without it is refused by both
    assert found["not obeyed", "true"][0] > found["not obeyed", "wrong"][0] + 20
    assert found["not obeyed", "wrong"][1] > 6.0 > found["not obeyed", "true"][1]
    # where it has none, the sharper prior is the better one, and its residuals fit
    assert found["obeyed", "wrong"][0] > found["obeyed", "true"][0] + 3
    assert found["obeyed", "wrong"][1] < 6.0


def test_components_are_a_fit_to_the_skies():
    x = FREQUENCIES / 20.0
    a, b = np.random.default_rng(1).standard_normal((2, N_MODES))
    exact = x[:, None] ** -2.5 * (a + b * np.log(x)[:, None])
    prior = components(FREQUENCIES, exact, ("power_law", "curvature"), residual=0.0)
    np.testing.assert_allclose(prior.spectra[0, 0], a[0] ** 2, rtol=1e-10)
    np.testing.assert_allclose(prior.spectra[1, 1], (b[1:4] ** 2).mean(), rtol=1e-10)
    np.testing.assert_allclose(prior.mixing[:, 1], x**-2.5 * np.log(x), rtol=1e-14)


def test_the_residual_is_that_share_of_every_sky():
    prior = components(FREQUENCIES, skies(), residual=0.05)
    expected = 0.05**2 * (skies()[:, 1:4] ** 2).mean(1)
    np.testing.assert_allclose(prior.residual[:, 1], expected, rtol=1e-12)


def test_bad_priors_and_channels_are_refused():
    all_four = FREQUENCIES, skies()
    refuse("'turnver'; did you mean 'turnover'", components, *all_four, ("turnver",))
    refuse("must not be negative", components, *all_four, residual=-0.1)
    few = FREQUENCIES[:2], skies()[:2]
    refuse("3 spectral components.*channels", components, *few)
    refuse("skies.*2 channels.*exactly", components, *few, ("power_law", "curvature"))
