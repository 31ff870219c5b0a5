"""Sample sites against scipy, and the programs of models/ against the analytic posterior."""

import importlib.util
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpyro import handlers
from numpyro.infer import MCMC, NUTS, Predictive
from scipy.stats import multivariate_normal

import lusee_bayes as lb

LMAX = 2
N_DATA = 30


def program(name):
    path = Path(__file__).parents[1] / "models" / f"{name}.py"
    spec = importlib.util.spec_from_file_location(name, path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.model


@pytest.fixture(scope="module")
def gaussian():
    rng = np.random.default_rng(1)
    root = rng.standard_normal((N_DATA, N_DATA))
    return lb.LinearGaussian(
        jnp.asarray(rng.standard_normal((N_DATA, (LMAX + 1) ** 2))),
        lb.HarmonicPrior(jnp.asarray([4.0, 1.0, 0.5])),
        lb.DenseCovariance(jnp.asarray(root @ root.T / N_DATA + np.eye(N_DATA))),
    )


def test_densities_against_scipy(gaussian):
    sky, data = gaussian.sample(jax.random.key(0))
    s, n = np.asarray(gaussian.prior.covariance()), np.asarray(gaussian.noise.dense())
    a = np.asarray(gaussian.coupling)
    prior = lb.SkyPrior(gaussian.prior).log_prob(sky)
    assert float(prior) == pytest.approx(multivariate_normal(cov=s).logpdf(sky), rel=1e-12)
    given = lb.CorrelatedNormal(gaussian.coupling @ sky, gaussian.noise).log_prob(data)
    expected = multivariate_normal(a @ np.asarray(sky), n).logpdf(data)
    assert float(given) == pytest.approx(expected, rel=1e-12)
    alone = lb.Marginal(gaussian).log_prob(data)
    expected = multivariate_normal(cov=a @ s @ a.T + n).logpdf(data)
    assert float(alone) == pytest.approx(expected, rel=1e-11)


def test_batches_and_draws(gaussian):
    normal = lb.CorrelatedNormal(jnp.arange(float(N_DATA)), gaussian.noise.factor())
    draws = normal.sample(jax.random.key(1), (4, 5000))
    assert draws.shape == (4, 5000, N_DATA)
    flat = np.asarray(draws).reshape(-1, N_DATA)
    n = np.asarray(gaussian.noise.dense())
    scale = np.sqrt(np.diag(n))
    # 20000 draws: means to 5 sigma / sqrt(20000), correlations to 5 / sqrt(20000) times sqrt(2)
    assert np.abs((flat.mean(0) - np.arange(N_DATA)) / scale).max() < 5 / np.sqrt(20000)
    error = (np.cov(flat.T) - n) / np.outer(scale, scale)
    assert np.abs(error).max() < 5 * np.sqrt(2 / 20000)
    one_by_one = [[float(normal.log_prob(x)) for x in row[:2]] for row in draws]
    np.testing.assert_allclose(normal.log_prob(draws)[:, :2], one_by_one, rtol=1e-12)
    for site in (lb.SkyPrior(gaussian.prior), lb.Marginal(gaussian)):
        drawn = site.sample(jax.random.key(2), (3,))
        assert drawn.shape == (3, *site.event_shape)
        assert site.log_prob(drawn).shape == (3,)


def test_priors_without_density_are_refused():
    spectrum = jnp.asarray([1.0, 0.0])
    with pytest.raises(lb.InputError, match="zero at some ell"):
        lb.SkyPrior(lb.HarmonicPrior(spectrum))
    with pytest.raises(lb.InputError, match="over pixels has no density"):
        lb.SkyPrior(lb.PixelPrior(spectrum, 1))


def test_handlers_and_predictive(gaussian):
    arguments = (gaussian.coupling, gaussian.prior, gaussian.noise.factor())
    sky, data = gaussian.sample(jax.random.key(3))
    trace = handlers.trace(handlers.substitute(program("sky"), {"sky": sky})).get_trace(
        *arguments, data=data
    )
    assert trace["data"]["is_observed"]
    total = sum(float(site["fn"].log_prob(site["value"])) for site in trace.values())
    joint = lb.SkyPrior(gaussian.prior).log_prob(sky) + lb.CorrelatedNormal(
        gaussian.coupling @ sky, gaussian.noise
    ).log_prob(data)
    assert total == pytest.approx(float(joint), rel=1e-12)
    drawn = Predictive(program("sky"), num_samples=7)(jax.random.key(4), *arguments)
    assert drawn["sky"].shape == (7, 9)
    assert drawn["data"].shape == (7, N_DATA)


def test_nuts_finds_the_analytic_posterior(gaussian):
    _, data = gaussian.sample(jax.random.key(5))
    posterior = gaussian.condition(data)
    mcmc = MCMC(
        NUTS(program("sky")), num_warmup=500, num_samples=2000, num_chains=2,
        chain_method="vectorized", progress_bar=False,
    )  # fmt: skip
    with jax.numpy_dtype_promotion("standard"):  # NumPyro's own code mixes types
        mcmc.run(
            jax.random.key(6), gaussian.coupling, gaussian.prior, gaussian.noise.factor(), data=data
        )
    draws = np.asarray(mcmc.get_samples()["sky"])
    std = np.asarray(posterior.std())
    # NUTS makes at least a tenth of its 4000 draws count: 400 independent ones, 5 sigma
    assert np.abs((draws.mean(0) - np.asarray(posterior.mean)) / std).max() < 5 / np.sqrt(400)
    assert np.abs(draws.std(0) / std - 1.0).max() < 5 / np.sqrt(2 * 400)
    assert int(mcmc.get_extra_fields()["diverging"].sum()) == 0


def test_the_marginal_program_finds_the_noise_level(gaussian):
    """Against the density of the noise level on a grid, normalised by the trapezoidal rule."""
    _, data = gaussian.sample(jax.random.key(7))
    mcmc = MCMC(NUTS(program("sky_marginal")), num_warmup=300, num_samples=2000, progress_bar=False)
    with jax.numpy_dtype_promotion("standard"):
        mcmc.run(jax.random.key(8), gaussian.coupling, gaussian.prior, gaussian.noise, data=data)
    draws = np.asarray(mcmc.get_samples()["noise_factor"])
    logs = np.linspace(-3.0, 3.0, 121)

    def log_density(x):
        scaled = lb.LinearGaussian(
            gaussian.coupling, gaussian.prior, gaussian.noise.scaled(jnp.exp(x))
        )
        return scaled.log_prob(data) - 0.5 * x**2

    values = np.array([float(log_density(jnp.asarray(x))) for x in logs])
    weights = np.exp(values - values.max())
    weights /= weights.sum()
    mean = weights @ logs
    spread = np.sqrt(weights @ (logs - mean) ** 2)
    # at least 400 of 2000 draws count; 5 sigma
    assert abs(np.log(draws).mean() - mean) < 5 * spread / np.sqrt(400)
    assert abs(np.log(draws).std() / spread - 1.0) < 5 / np.sqrt(2 * 400)
