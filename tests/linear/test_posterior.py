"""What a posterior reports about itself, against the textbook covariance."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from reference_linear import assert_draws_follow, posterior, random_covariance

import lusee_bayes as lb
from lusee_bayes.linear import posterior as posterior_module
from lusee_bayes.linear.model import FORMS, LinearGaussian

SPECTRUM = np.array([4.0, 1.0, 0.5, 0.25])
PER_MODE = np.repeat(SPECTRUM, [1, 3, 5, 7])
SIZES = [30, 9]  # more and fewer data than the 16 modes
# numbers of order one, condition below 1e4: 1e4 x 16 x eps
TOL = 1e-10


def conditioned(n_data, form, prior=None, blind=False):
    """(posterior, the naive one); ``blind``: the last ell is not seen by the data at all."""
    rng = np.random.default_rng(n_data)
    a = rng.normal(size=(n_data, 16))
    if blind:
        a[:, 9:] = 0.0
    n, d = random_covariance(rng, n_data), rng.normal(size=n_data)
    prior = lb.HarmonicPrior(jnp.asarray(SPECTRUM)) if prior is None else prior
    a = jnp.asarray(a)
    a = prior.coupling(a) if isinstance(prior, lb.PixelPrior) else a
    model = LinearGaussian(a, prior, lb.DenseCovariance(jnp.asarray(n)))
    return model.condition(jnp.asarray(d), form), posterior(a, prior.covariance(), n, d)


cases = pytest.mark.parametrize(("n_data", "form"), [(n, f) for n in SIZES for f in FORMS])


@cases
def test_covariance_and_standard_deviations(n_data, form):
    post, expected = conditioned(n_data, form)
    covariance = np.asarray(post.covariance())
    np.testing.assert_allclose(covariance, expected.covariance, atol=TOL)
    np.testing.assert_allclose(covariance, covariance.T, atol=1e-15)
    assert np.linalg.eigvalsh(covariance).min() > 0
    np.testing.assert_allclose(post.std(), expected.std, rtol=TOL)
    np.testing.assert_allclose(post.mean, expected.mean, atol=TOL)


@cases
def test_std_of_any_direction(n_data, form):
    post, expected = conditioned(n_data, form)
    directions = np.random.default_rng(0).normal(size=(23, 16))
    variance = np.einsum("ni,ij,nj->n", directions, expected.covariance, directions)
    np.testing.assert_allclose(post.std_of(jnp.asarray(directions)), np.sqrt(variance), rtol=TOL)


def test_std_of_does_not_depend_on_the_chunks(monkeypatch):
    post, _ = conditioned(30, "map")
    directions = jnp.asarray(np.random.default_rng(0).normal(size=(23, 16)))
    whole = np.asarray(post.std_of(directions))
    monkeypatch.setattr(posterior_module, "CHUNK", 5)  # 4 chunks of 5 and one of 3
    np.testing.assert_allclose(post.std_of(directions), whole, rtol=1e-14)


@cases
def test_draws_have_the_posteriors_mean_and_covariance(n_data, form):
    """Every entry; a sqrt(2) in the random term would be off by 100 sigma."""
    post, expected = conditioned(n_data, form)
    draws = post.sample(jax.random.key(n_data), 20_000)
    assert draws.shape == (20_000, 16)
    assert_draws_follow(draws, expected.mean, expected.covariance)
    assert post.sample(jax.random.key(0)).shape == (16,)


def test_the_draw_test_notices_sqrt_two():
    post, expected = conditioned(30, "map")
    draws = np.asarray(post.sample(jax.random.key(0), 20_000))
    narrow = expected.mean + (draws - expected.mean) / np.sqrt(2)
    with pytest.raises(AssertionError, match="sample covariance off"):
        assert_draws_follow(narrow, expected.mean, expected.covariance)
    with pytest.raises(AssertionError, match="sample mean off"):
        assert_draws_follow(draws + 0.1 * expected.std, expected.mean, expected.covariance)


def test_draws_in_pixels():
    """More unknowns than normals behind them: the covariance has rank 16 of 48."""
    prior = lb.PixelPrior(jnp.asarray(SPECTRUM), 2)
    for form in FORMS:
        post, expected = conditioned(9, form, prior)
        draws = post.sample(jax.random.key(5), 20_000)
        assert_draws_follow(draws, expected.mean, expected.covariance)


@cases
def test_prior_fraction(n_data, form):
    post, expected = conditioned(n_data, form)
    got = np.asarray(post.prior_fraction())
    np.testing.assert_allclose(got, expected.std**2 / PER_MODE, rtol=TOL)
    assert ((got > 0) & (got < 1)).all()


@cases
def test_modes_that_the_data_do_not_see_keep_their_prior(n_data, form):
    post, expected = conditioned(n_data, form, blind=True)
    fraction = np.asarray(post.prior_fraction())
    np.testing.assert_allclose(fraction[9:], 1.0, rtol=1e-14)
    assert (fraction[:9] < 1).all()
    np.testing.assert_allclose(np.asarray(post.mean)[9:], 0.0, atol=1e-14)
    draws = post.sample(jax.random.key(2), 20_000)
    assert_draws_follow(draws, expected.mean, expected.covariance)


@cases
def test_information_is_the_shrinkage_of_the_covariance(n_data, form):
    """log2 of the ratio of the volumes, sqrt(|S| / |C|): the mutual information in bits."""
    post, expected = conditioned(n_data, form)
    bits = 0.5 * (np.log2(PER_MODE).sum() - np.linalg.slogdet(expected.covariance)[1] / np.log(2))
    assert float(post.information_bits()) == pytest.approx(bits, rel=TOL)


def blind_or_not(n_data, form):
    for blind in (False, True):
        yield conditioned(n_data, form, blind=blind)


@cases
def test_the_root_times_its_transpose_is_the_covariance(n_data, form):
    """Against the textbook covariance, too: covariance() shares its solves with the root."""
    for post, expected in blind_or_not(n_data, form):
        root = np.asarray(post.root())
        assert root.shape == (16, 16)
        np.testing.assert_allclose(root @ root.T, expected.covariance, atol=TOL)
        np.testing.assert_allclose(root @ root.T, post.covariance(), atol=TOL)


def test_the_root_of_a_singular_covariance():
    """Over pixels (rank 16 of 48), and with C_1 = 0: no inverse, but draws are mean + R z."""
    for form in FORMS:
        post, expected = conditioned(9, form, lb.PixelPrior(jnp.asarray(SPECTRUM), 2))
        root = np.asarray(post.root())
        assert root.shape == (48, 16)
        np.testing.assert_allclose(root @ root.T, expected.covariance, atol=TOL)
        spectrum = SPECTRUM * np.array([1.0, 0.0, 1.0, 1.0])
        post, expected = conditioned(9, form, lb.HarmonicPrior(jnp.asarray(spectrum)))
        root = np.asarray(post.root())
        assert (root[1:4] == 0).all()
        np.testing.assert_allclose(root @ root.T, expected.covariance, atol=TOL)


@cases
def test_whitening_inverts_mean_plus_root_times_z(n_data, form):
    for post, expected in blind_or_not(n_data, form):
        z = np.random.default_rng(3).normal(size=(7, 16))
        skies = np.asarray(post.mean) + z @ np.asarray(post.root()).T
        np.testing.assert_allclose(post.whiten(jnp.asarray(skies)), z, atol=TOL)
        np.testing.assert_allclose(post.whiten(skies), z, atol=TOL)  # numpy arrays, too
        # squared lengths: the distance from the mean in the textbook covariance's metric, whose
        # inverse loses its condition, below 1e5 with the prior's range
        delta = skies - expected.mean
        squared = np.einsum("ni,in->n", delta, np.linalg.solve(expected.covariance, delta.T))
        np.testing.assert_allclose((np.asarray(post.whiten(skies)) ** 2).sum(1), squared, rtol=1e-9)


@cases
def test_draws_are_white_in_their_own_coordinates_and_not_in_others(n_data, form):
    post, _ = conditioned(n_data, form)
    white = post.whiten(post.sample(jax.random.key(4), 20_000))
    assert_draws_follow(white, np.zeros(16), np.eye(16))
    other, _ = conditioned(n_data, form, blind=True)
    with pytest.raises(AssertionError, match="off by"):
        assert_draws_follow(
            other.whiten(post.sample(jax.random.key(4), 20_000)), np.zeros(16), np.eye(16)
        )


def test_whitening_in_a_traced_program():
    """Under jit the spectrum's values are not known; the check of them must not get in the way."""
    post, _ = conditioned(9, "data")
    skies = post.sample(jax.random.key(6), 3)
    traced = jax.jit(lambda posterior, x: posterior.whiten(x))(post, skies)
    np.testing.assert_allclose(traced, post.whiten(skies), atol=TOL)


@pytest.mark.parametrize("form", FORMS)
def test_what_has_no_inverse_is_not_whitened(form):
    pixels, _ = conditioned(9, form, lb.PixelPrior(jnp.asarray(SPECTRUM), 2))
    with pytest.raises(lb.InputError, match="prior over pixels is singular"):
        pixels.whiten(pixels.sample(jax.random.key(0), 2))
    spectrum = jnp.asarray([4.0, 0.0, 0.5, 0.25])
    powerless, _ = conditioned(9, form, lb.HarmonicPrior(spectrum))
    with pytest.raises(lb.InputError, match="zero at ell = 1 and has no density"):
        powerless.whiten(powerless.sample(jax.random.key(0), 2))
