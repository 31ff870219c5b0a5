"""Sample sites against scipy, and the programs of models/ against the analytic posterior.

White coordinates are tested on the densities: whatever they are taken from, the density of z is
the program's own at m = mean + R z, times |det R|.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import numpyro
import pytest
from assertions import refuse
from numpyro import distributions as dist
from numpyro import handlers, infer
from numpyro.infer.util import log_density
from reference_linear import assert_draws_follow, matrices, z_of
from scipy.stats import multivariate_normal
from small_models import random_gaussian

import lusee_bayes as lb
from lusee_bayes.linear.linear_gaussian import FromInformation, InData, InMap
from lusee_bayes.noise.covariance import DenseCovariance
from lusee_bayes.sampling import mode, programs
from lusee_bayes.sampling.hmc import Whitening, whitened
from lusee_bayes.sky.prior import DensePrior

LMAX = 2
N_DATA = 30


def program(name):
    return lb.load_program(name).model


@pytest.fixture(scope="module")
def gaussian():
    return random_gaussian([4.0, 1.0, 0.5], N_DATA, 1)


def test_densities_against_scipy(gaussian):
    sky, data = gaussian.sample(jax.random.key(0))
    a, s, n = matrices(gaussian)
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
    assert_draws_follow(flat, np.arange(N_DATA), gaussian.noise.dense())
    one_by_one = [[float(normal.log_prob(x)) for x in row[:2]] for row in draws]
    np.testing.assert_allclose(normal.log_prob(draws)[:, :2], one_by_one, rtol=1e-12)
    for site in (lb.SkyPrior(gaussian.prior), lb.Marginal(gaussian)):
        drawn = site.sample(jax.random.key(2), (3,))
        assert drawn.shape == (3, *site.event_shape) and site.log_prob(drawn).shape == (3,)


# --- white coordinates ----------------------------------------------------------------------------


def strong_sky(coupling, offset, prior, fixed_noise, data=None):
    """A program whose prior, noise and coupling are not those that the whitening was made with."""
    amplitude = numpyro.sample("amplitude", dist.LogNormal(0.0, 0.5))
    sky = numpyro.sample("sky", lb.SkyPrior(lb.HarmonicPrior(prior.spectrum * amplitude)))
    seen = coupling @ sky + offset
    numpyro.sample("data", lb.CorrelatedNormal(seen + 0.1 * seen**2, fixed_noise), obs=data)


def joint(model, arguments, values):
    """ln p of all sites at these values, by NumPyro, whose own code mixes types."""
    with programs.numpyro_promotion():
        return float(log_density(model, (), arguments, values)[0])


@pytest.fixture(scope="module")
def case(gaussian):
    """(arguments of a program with data, whitening by the posterior given them)."""
    _, data = gaussian.sample(jax.random.key(9))
    arguments = lb.load_program("sky").arguments(gaussian) | {"data": data}
    return arguments, lb.Whitening.of(gaussian.condition(data).posterior)


@pytest.fixture(scope="module")
def z():
    return jnp.asarray(np.random.default_rng(2).standard_normal((LMAX + 1) ** 2))


@pytest.mark.parametrize("form", [InMap, InData, FromInformation])
@pytest.mark.parametrize("n_data", [N_DATA, 5])
def test_the_log_determinant_is_that_of_the_root(gaussian, n_data, form):
    """More and fewer data than the 9 modes, in both forms of the posterior."""
    noise = DenseCovariance(gaussian.noise.matrix[:n_data, :n_data])
    few = lb.LinearGaussian(gaussian.coupling.dense()[:n_data], gaussian.prior, noise)
    posterior = few.condition(few.sample(jax.random.key(1))[1], form).posterior
    whitening = lb.Whitening.of(posterior)
    # a sum of 9 logarithms of order one, and of a root with condition below 100
    log_det = np.linalg.slogdet(np.asarray(whitening.root))[1]
    assert float(whitening.log_det) == pytest.approx(log_det, abs=1e-12)
    halved = 0.5 * np.linalg.slogdet(np.asarray(posterior.covariance()))[1]
    assert float(whitening.log_det) == pytest.approx(halved, abs=1e-11)
    np.testing.assert_array_equal(whitening.mean, posterior.mean)


def test_what_has_no_density_is_refused():
    prior = lb.HarmonicPrior(jnp.asarray([1.0, 0.0]))
    refuse("zero at ell = 1", lb.SkyPrior, prior)
    a = jnp.asarray(np.random.default_rng(0).standard_normal((3, prior.size)))
    model = lb.LinearGaussian(a, prior, lb.DiagonalCovariance(jnp.ones(3)))
    refuse("has no density", lb.Whitening.of, model.condition(jnp.ones(3)).posterior)


def test_the_density_of_z_is_the_programs_own_times_the_determinant(gaussian, case, z):
    """For any coordinates, and a program for which they are the wrong ones."""
    arguments, right = case
    wrong = lb.Whitening.of(gaussian.condition(3.0 + 2.0 * arguments["data"], InData).posterior)
    twice = 2.0 * wrong.root, wrong.log_det + 9 * np.log(2.0)
    wrong = eqx.tree_at(lambda w: (w.root, w.log_det), wrong, twice)
    for model, others in [(program("sky"), {}), (strong_sky, {"amplitude": jnp.asarray(1.7)})]:
        for whitening in (right, wrong):
            plain = joint(model, arguments, {"sky": whitening.mean + whitening.root @ z, **others})
            expected = plain + np.linalg.slogdet(np.asarray(whitening.root))[1]
            got = joint(whitened(model, whitening), arguments, {"sky_white": z, **others})
            # terms up to 1e4, summed in another order: 1e4 x 10 x eps
            assert got == pytest.approx(expected, abs=1e-11, rel=1e-13)
            # and the determinant is not a detail
            assert abs(got - plain) > 1.0


def test_z_is_standard_normal_where_the_coordinates_are_the_posteriors(gaussian, case, z):
    """p(d, m) |dm/dz| = p(d) N(z; 0, 1), with the evidence by scipy."""
    arguments, whitening = case
    a, s, n = matrices(gaussian)
    evidence = multivariate_normal(cov=a @ s @ a.T + n).logpdf(arguments["data"])
    for factor in (0.0, 1.0, -5.0):
        at = factor * np.asarray(z)
        expected = evidence + multivariate_normal(cov=np.eye(9)).logpdf(at)
        got = joint(whitened(program("sky"), whitening), arguments, {"sky_white": jnp.asarray(at)})
        assert got == pytest.approx(expected, rel=1e-11)


def test_a_site_in_a_plate_keeps_its_density():
    def plated(data=None):
        with numpyro.plate("bands", 3):
            numpyro.sample("sky", dist.LogNormal(0.0, 1.0))

    def plain(data=None):
        numpyro.sample("sky", dist.LogNormal(0.0, 1.0).expand([3]).to_event(1))

    whitening = Whitening(jnp.zeros(3), jnp.eye(3), jnp.zeros(()), (("sky", (3,)),))
    at = {"sky_white": np.array([0.3, -2.0, 1.0])}
    assert joint(whitened(plated, whitening), {}, at) == joint(whitened(plain, whitening), {}, at)


@pytest.mark.parametrize("how", ["obs", "condition"])
def test_an_observed_sky_is_not_whitened(case, z, how):
    arguments, whitening = case

    def observed(coupling, offset, prior, fixed_noise, data=None):
        numpyro.sample("sky", lb.SkyPrior(prior), obs=z)

    model = observed if how == "obs" else handlers.condition(program("sky"), {"sky": z})
    given = handlers.substitute(whitened(model, whitening), {"sky_white": z})
    refuse("the site 'sky' is observed", given, **arguments)


def test_predictions_from_draws_of_z(gaussian, case):
    """Data seen again have mean A E[m | d] and covariance A C A^T + N."""
    arguments, whitening = case
    posterior, n = gaussian.condition(arguments["data"]).posterior, 4000
    z = jax.random.normal(jax.random.key(3), (n, 9), dtype=jnp.float64)
    with programs.numpyro_promotion():
        predictive = infer.Predictive(whitened(program("sky"), whitening), {"sky_white": z})
        drawn = predictive(jax.random.key(4), **(arguments | {"data": None}))
    expected = np.asarray(whitening.mean) + np.asarray(z) @ np.asarray(whitening.root).T
    np.testing.assert_allclose(drawn["sky"], expected, rtol=1e-13, atol=1e-13)
    a = np.asarray(gaussian.coupling.dense())
    variance = np.diag(a @ np.asarray(posterior.covariance()) @ a.T + gaussian.noise.dense())
    delta = np.asarray(drawn["data"]) - a @ np.asarray(posterior.mean)
    limit = z_of(2 * N_DATA)
    assert np.abs(delta.mean(0) / np.sqrt(variance / n)).max() < limit
    assert np.abs((delta**2).mean(0) / variance - 1.0).max() < limit * np.sqrt(2 / n)


def test_the_gaussian_about_the_mode_of_a_linear_model_is_its_posterior():
    """Of a prior that correlates modes: its curvature is no diagonal."""
    rng = np.random.default_rng(8)
    half, program = rng.standard_normal((9, 9)), lb.load_program("sky")
    prior = DensePrior(jnp.linalg.cholesky(half @ half.T + np.eye(9)))
    a, data = (jnp.asarray(rng.standard_normal(shape)) for shape in ((6, 9), 6))
    model = lb.LinearGaussian(a, prior, lb.DiagonalCovariance(jnp.ones(6)))
    found = mode.laplace_approximation(program.model, {**program.arguments(model), "data": data})
    expected, root = model.condition(data).posterior, np.asarray(found.whitening.root)
    np.testing.assert_allclose(found.whitening.mean, expected.mean, atol=1e-9)
    np.testing.assert_allclose(root @ root.T, expected.covariance(), atol=1e-9)
    assert float(found.log_evidence) == pytest.approx(float(expected.log_evidence), abs=1e-8)
