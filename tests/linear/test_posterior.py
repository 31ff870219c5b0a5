"""What a posterior reports about itself, against the textbook covariance."""

from itertools import product

import healpy
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference_linear as oracle
from assertions import refuse

import lusee_bayes as lb
from lusee_bayes.core.harmonics import to_healpy
from lusee_bayes.judge import measures
from lusee_bayes.linear.linear_gaussian import FromInformation, InData, InMap
from lusee_bayes.noise.covariance import DenseCovariance

FORMS = (InMap, InData, FromInformation)
SPECTRUM = np.array([4.0, 1.0, 0.5, 0.25])
PER_MODE = np.repeat(SPECTRUM, [1, 3, 5, 7])
SIZES = [30, 9]  # more and fewer data than the 16 modes
# numbers of order one, condition below 1e4: 1e4 x 16 x eps
TOL = 1e-10


def problem(n_data, prior=None, blind=False):
    """A model and data; ``blind``: the last ell is not seen by the data at all."""
    rng = np.random.default_rng(n_data)
    a = rng.normal(size=(n_data, 16))
    if blind:
        a[:, 9:] = 0.0
    n, d = oracle.random_covariance(rng, n_data), rng.normal(size=n_data)
    prior = lb.HarmonicPrior(jnp.asarray(SPECTRUM)) if prior is None else prior
    return lb.LinearGaussian(jnp.asarray(a), prior, DenseCovariance(jnp.asarray(n))), jnp.asarray(d)


def conditioned(n_data, form, prior=None, blind=False):
    """The posterior, and the naive one."""
    model, d = problem(n_data, prior, blind)
    return model.condition(d, form).posterior, oracle.posterior(*oracle.matrices(model), d)


cases = pytest.mark.parametrize(("n_data", "form"), [(n, f) for n in SIZES for f in FORMS])


@cases
def test_what_it_says_of_itself(n_data, form):
    """Among it log2 of the ratio of the volumes, sqrt(|S| / |C|): the mutual information."""
    post, expected = conditioned(n_data, form)
    got = np.asarray(post.prior_fraction())
    np.testing.assert_allclose(got, expected.std**2 / PER_MODE, rtol=TOL)
    assert ((got > 0) & (got < 1)).all()
    bits = 0.5 * (np.log2(PER_MODE).sum() - np.linalg.slogdet(expected.covariance)[1] / np.log(2))
    assert float(post.information_bits()) == pytest.approx(bits, rel=TOL)
    directions = np.random.default_rng(0).normal(size=(23, 16))
    variance = np.einsum("ni,ij,nj->n", directions, expected.covariance, directions)
    squares = ((directions @ np.asarray(post.root())) ** 2).sum(1)
    np.testing.assert_allclose(squares, variance, rtol=2 * TOL)
    pixels = [0, 55, 190]
    y = np.stack([healpy.alm2map(to_healpy(one), 4)[pixels] for one in np.eye(16)], axis=1)
    found = post.pixel_covariance(*healpy.pix2ang(4, np.array(pixels), lonlat=True))
    np.testing.assert_allclose(found, y @ expected.covariance @ y.T, rtol=0, atol=1e-9)


@cases
def test_draws_have_the_posteriors_mean_and_covariance(n_data, form):
    """Every entry; a sqrt(2) in the random term would be off by 100 sigma."""
    post, expected = conditioned(n_data, form)
    draws = post.sample(jax.random.key(n_data), 20_000)
    assert draws.shape == (20_000, 16)
    oracle.assert_draws_follow(draws, expected.mean, expected.covariance)
    assert post.sample(jax.random.key(0)).shape == (16,)


def test_the_draw_test_notices_sqrt_two():
    post, expected = conditioned(30, InMap)
    draws = np.asarray(post.sample(jax.random.key(0), 20_000))
    narrow = expected.mean + (draws - expected.mean) / np.sqrt(2)
    with pytest.raises(AssertionError, match="sample covariance off"):
        oracle.assert_draws_follow(narrow, expected.mean, expected.covariance)
    with pytest.raises(AssertionError, match="sample mean off"):
        oracle.assert_draws_follow(draws + 0.1 * expected.std, expected.mean, expected.covariance)


def blind_or_not(n_data, form):
    return [conditioned(n_data, form, blind=blind) for blind in (False, True)]


@cases
def test_the_root_times_its_transpose_is_the_covariance(n_data, form):
    """Against the textbook covariance, too: covariance() shares its solves with the root.

    With C_1 = 0 it has no inverse, but draws are mean + R z.
    """
    singular = conditioned(n_data, form, SINGULAR)
    assert (np.asarray(singular[0].root())[1:4] == 0).all()
    for post, expected in [*blind_or_not(n_data, form), singular]:
        root = np.asarray(post.root())
        assert root.shape == (16, 16)
        np.testing.assert_allclose(root @ root.T, expected.covariance, atol=TOL)
        covariance = np.asarray(post.covariance())
        np.testing.assert_allclose(root @ root.T, covariance, atol=TOL)
        np.testing.assert_allclose(covariance, covariance.T, atol=1e-15)


SINGULAR = lb.HarmonicPrior(jnp.asarray([4.0, 0.0, 0.5, 0.25]))


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


def test_whitening_in_a_traced_program():
    """Under jit the spectrum's values are not known; the check of them must not get in the way."""
    post, _ = conditioned(9, InData)
    skies = post.sample(jax.random.key(6), 3)
    traced = jax.jit(lambda posterior, x: posterior.whiten(x))(post, skies)
    np.testing.assert_allclose(traced, post.whiten(skies), atol=TOL)


def test_what_has_no_inverse_is_not_whitened():
    for form in FORMS:
        post, _ = conditioned(9, form, SINGULAR)
        refuse("zero.*ell = 1.* no", post.whiten, post.sample(jax.random.key(0), 2))


# --- fidelity -------------------------------------------------------------------------------------


LMAX = 5


def test_rho_and_snr_against_complex_coefficients_and_loops():
    # the paper writes them with complex a_lm over m = -ell..ell; healpy keeps m >= 0
    mean, truth = np.random.default_rng(1).standard_normal((2, (LMAX + 1) ** 2))
    a, b = to_healpy(mean), to_healpy(truth)
    rho, snr = measures.correlation(mean, truth), measures.signal_to_noise(mean, truth)
    for ell in range(LMAX + 1):
        ab = aa = bb = dd = 0.0
        for m in range(ell + 1):
            index, weight = healpy.Alm.getidx(LMAX, ell, m), 1 if m == 0 else 2
            x, y = a[index], b[index]
            ab += weight * (x * np.conj(y)).real
            aa, bb = aa + weight * abs(x) ** 2, bb + weight * abs(y) ** 2
            dd += weight * abs(x - y) ** 2
        assert rho[ell] == pytest.approx(ab / np.sqrt(aa * bb), rel=1e-12)
        assert snr[ell] == pytest.approx(np.sqrt(aa / dd), rel=1e-12)


def test_measures_of_made_up_maps():
    truth = np.random.default_rng(2).standard_normal(16)
    np.testing.assert_allclose(measures.correlation(truth, truth), 1.0, rtol=1e-12)
    # no residual: undefined, not infinite
    assert np.isnan(measures.signal_to_noise(truth, truth)).all()
    assert np.isnan(measures.correlation(np.zeros(16), truth)).all()
    # ell counts from one
    assert measures.ell_cross(np.array([0.1, 3.0, 2.0, 0.9, 2.0])) == 3
    assert measures.ell_cross(np.array([0.1, 3.0])) is None
    assert measures.effective_resolution_deg(np.array([1.0, 0.1, 0.4, 0.6, 0.2])) == 60.0
    assert measures.effective_resolution_deg(np.array([0.0, 0.1])) is None


def test_expected_chi2_and_prior_fraction_per_ell():
    """The mean of |r|^2 over data from the model is tr N K^-1 = tr (1 + W W^T)^-1."""
    rng = np.random.default_rng(5)
    a, variance = rng.standard_normal((60, 16)), rng.uniform(0.5, 2.0, 60)
    noise, prior = (lb.DiagonalCovariance(jnp.asarray(variance)), lb.HarmonicPrior(SPECTRUM))
    post = lb.LinearGaussian(jnp.asarray(a), prior, noise).condition(jnp.zeros(60)).posterior
    inverse = np.linalg.inv(a * PER_MODE @ a.T + np.diag(variance))
    assert measures.expected_chi2(post, 60) == pytest.approx(variance @ np.diag(inverse), rel=1e-10)
    left = 1.0 - np.einsum("di,de,ei->i", a, inverse, a) * PER_MODE
    expected = [np.mean(left[e**2 : (e + 1) ** 2]) for e in range(4)]
    np.testing.assert_allclose(measures.prior_fraction_per_ell(post), expected, rtol=1e-10)


@pytest.mark.parametrize("terrain_deg", [0.0, 20.0])
def test_the_sky_that_never_rises_is_a_cap_round_the_north_pole(terrain_deg):
    # from latitude -23.8 the Moon's north pole stays 23.8 degrees below the horizon; the site sees
    # all but a cap of that radius about it in one cycle (paper: "within ~24 degrees of the NCP")
    observation, nside = lb.Observation.from_runs([lb.Run()], step_s=3600.0), 32
    terrain = lambda azimuth: np.full(azimuth.shape, np.radians(terrain_deg))  # noqa: E731
    hidden = measures.highest_altitude(observation, nside, terrain=terrain) < 0
    radius = np.radians(terrain_deg - observation.lat_deg)
    expected = (1 - np.cos(radius)) / 2
    # pixels on the rim: 2 pi sin(radius) / pixel size of them, half a pixel each at worst
    rim = 2 * np.pi * np.sin(radius) * healpy.nside2resol(nside) / (4 * np.pi) / 2
    assert abs(hidden.mean() - expected) < rim
    pole = observation.mcmf_from_galactic[:, 2].mean(axis=0)
    distance = np.arccos(np.array(healpy.pix2vec(nside, np.flatnonzero(hidden))).T @ pole)
    assert distance.max() < radius + 0.002  # the axis wanders by 0.0008 rad


def test_what_never_rises_depends_on_times_with_data_and_on_terrain_by_azimuth():
    observation = lb.Observation.from_runs([lb.Run()], step_s=14400.0)
    seen = np.arange(observation.n_times) < 60
    cut = measures.highest_altitude(observation.select(seen), 8)
    np.testing.assert_array_equal(measures.highest_altitude(observation, 8, seen), cut)
    wall = lambda azimuth: np.where(np.sin(azimuth) > 0.0, np.pi / 2.0, 0.0)  # noqa: E731
    first = np.arange(observation.n_times) == 0
    risen = measures.highest_altitude(observation, 8, first, wall) > 0
    turned = observation.topocentric_from_mcmf() @ observation.mcmf_from_galactic[0]
    east, _, up = turned @ np.array(healpy.pix2vec(8, np.arange(768)))
    assert (risen == ((up > 0) & (east < 0))).all()


def test_rows_of_the_resolution_are_what_the_map_shows_of_each_source():
    """y^T R, an oracle of pages, against maps of noiseless data of sources."""
    for n_data, form in product(SIZES, FORMS):
        model, data = problem(n_data)
        solver = model.factorise(form)
        y, sources = np.random.default_rng(4).normal(size=(2, 5, 16))
        seen = (model.coupling @ jnp.asarray(source) for source in sources)
        mapped = np.array([solver.condition(one).posterior.mean for one in seen])
        rows = oracle.resolution_rows(solver.condition(data).posterior, y)
        np.testing.assert_allclose(rows @ sources.T, y @ mapped.T, atol=TOL)
