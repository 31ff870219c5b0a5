"""Priors on the sky: S in coefficients, priors with a mean, families of priors."""

from dataclasses import replace

import healpy as hp
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from assertions import refuse
from reference_linear import posterior, random_covariance
from scipy.integrate import quad
from scipy.special import eval_legendre

import lusee_bayes as lb
from lusee_bayes.core.harmonics import n_modes, per_mode, pixel_matrix, synthesis_matrix
from lusee_bayes.core.sphere_grid import SphereGrid
from lusee_bayes.experiment.model import base_model
from lusee_bayes.judge.residuals import residuals
from lusee_bayes.priors import families, local_scales
from lusee_bayes.sky.prior import DensePrior, IndependentPrior
from lusee_bayes.testing import check_prior

SPECTRUM = np.array([4.0, 1.0, 0.0, 0.25])  # nothing at ell = 2
LMAX, NSIDE = 3, 2
PER_MODE = np.array([SPECTRUM[ell] for ell in range(LMAX + 1) for _ in range(2 * ell + 1)])


def pixel_covariance() -> np.ndarray:
    """S_pq = sum_l (2l+1)/(4 pi) C_l P_l(cos angle_pq): the addition theorem, no harmonics."""
    vectors = np.array(hp.pix2vec(NSIDE, np.arange(12 * NSIDE**2)))
    cosine = np.clip(vectors.T @ vectors, -1.0, 1.0)
    terms = ((2 * k + 1) * c * eval_legendre(k, cosine) for k, c in enumerate(SPECTRUM))
    return sum(terms) / (4 * np.pi)


def dense_covariance() -> np.ndarray:
    return random_covariance(np.random.default_rng(4), 16, scale=3.0)


ROOT, MEAN = np.linspace(0.5, 2.0, 6), np.linspace(-2.0, 5.0, 16)
HOLES = np.where(PER_MODE > 0, MEAN, 0.0)
KINDS = {
    "harmonic": lambda: (lb.HarmonicPrior(jnp.asarray(SPECTRUM)), np.diag(PER_MODE)),
    "harmonic about a mean": lambda: (
        lb.HarmonicPrior(jnp.asarray(SPECTRUM), mean=jnp.asarray(HOLES)),
        np.diag(PER_MODE),
        HOLES,
    ),
    "independent": lambda: (IndependentPrior(jnp.asarray(ROOT)), np.diag(ROOT**2)),
    "dense about a mean": lambda: (
        DensePrior(jnp.linalg.cholesky(dense_covariance()), mean=jnp.asarray(MEAN)),
        dense_covariance(),
        MEAN,
    ),
}


@pytest.mark.parametrize("kind", KINDS)
def test_every_prior_keeps_the_contract(kind):
    check_prior(*KINDS[kind]())


def test_the_contract_notices_a_wrong_prior():
    class Transposed(DensePrior):
        def colour_columns(self, a):
            return a @ self.root.T

    class Uncentred(DensePrior):
        @property
        def white_mean(self):
            return self.mean

    prior = DensePrior(np.linalg.cholesky(dense_covariance()), mean=MEAN)
    for wrong in (Transposed, Uncentred):
        with pytest.raises(AssertionError):
            check_prior(wrong(prior.root, mean=prior.mean), dense_covariance(), MEAN)
    with pytest.raises(AssertionError):
        check_prior(prior, 1.1 * dense_covariance(), MEAN)


def test_what_no_prior_is_is_refused():
    dense, harmonic, root = DensePrior, lb.HarmonicPrior, np.linalg.cholesky(dense_covariance())
    refuse("Cholesky factor: lower triangular, diagonal > 0", dense, dense_covariance())
    refuse("the prior mean has shape", dense, root, mean=np.zeros(9))
    refuse("the root of the prior.*NaN", dense, np.full((4, 4), np.nan))
    negative = jnp.array([1.0, 1.0, -0.5, -1.0])
    refuse(r"C_ell of the prior is -0\.5 at ell = 2: negative", harmonic, negative)
    refuse("prior spectrum.*NaN", harmonic, jnp.array([1.0, jnp.nan]))
    spectrum = jnp.asarray(SPECTRUM)
    refuse("ell = 2 the prior has a mean, but no variance", harmonic, spectrum, mean=MEAN)
    refuse("the prior mean has shape", harmonic, spectrum[:2], mean=MEAN)


def test_pixels_of_an_isotropic_sky_are_those_of_the_addition_theorem():
    rng, y = np.random.default_rng(3), pixel_matrix(NSIDE, LMAX)
    np.testing.assert_allclose(y * PER_MODE @ y.T, pixel_covariance(), atol=1e-14)
    a, d, variance = rng.normal(size=(24, 16)), rng.normal(size=24), rng.uniform(0.5, 2.0, 24)
    prior, noise = lb.HarmonicPrior(SPECTRUM), lb.DiagonalCovariance(jnp.asarray(variance))
    found = lb.LinearGaussian(jnp.asarray(a), prior, noise).condition(jnp.asarray(d)).posterior
    # A Y^+ sees a sky of pixels; numbers of order one, and a posterior of condition below 1e3
    naive = posterior(a @ np.linalg.pinv(y), pixel_covariance(), np.diag(variance), d)
    np.testing.assert_allclose(y @ np.asarray(found.mean), naive.mean, atol=1e-12)
    std = np.linalg.norm(y @ np.asarray(found.root()), axis=1)
    np.testing.assert_allclose(std, naive.std, rtol=1e-11)


def test_a_prior_can_be_built_inside_jit_from_known_numbers():
    got = jax.jit(lambda u: lb.HarmonicPrior(jnp.asarray(SPECTRUM)).colour(u))(jnp.ones(16))
    np.testing.assert_allclose(got, np.sqrt(PER_MODE))


def test_an_ell_without_power_does_not_spoil_gradients():
    def total(amplitude):
        return lb.HarmonicPrior(amplitude * jnp.asarray(SPECTRUM)).colour(jnp.ones(16)).sum()

    expected = np.sqrt(PER_MODE).sum() / 2.0  # d/da of sqrt(a) sum sqrt(C) at a = 1
    assert float(jax.jit(jax.grad(total))(jnp.asarray(1.0))) == pytest.approx(expected)


def test_a_dense_prior_of_any_root():
    """Wide and ill conditioned: S = R R^T is not formed."""
    rng = np.random.default_rng(8)
    for columns in (6, 9):
        root = rng.normal(size=(6, columns)) * np.geomspace(1.0, 1e-7, 6)[:, None]
        prior = DensePrior.of_root(root, np.arange(6.0))
        np.testing.assert_array_equal(prior.root, np.tril(prior.root))
        np.testing.assert_allclose(prior.covariance(), root @ root.T, rtol=1e-9)
        np.testing.assert_array_equal(prior.mean, np.arange(6.0))
    refuse("diagonal > 0", DensePrior.of_root, np.zeros((3, 3)))


def test_residuals_are_those_of_the_data_less_the_mean(small_experiment):
    """The same posterior and the same verdicts as of d - A mu with a prior about zero."""
    setup, data = small_experiment.setup, small_experiment.data
    mean, about_zero = 0.5 * np.asarray(setup.sky.modes), base_model(setup)
    about_mean = replace(about_zero, prior=lb.HarmonicPrior(setup.prior.spectrum, mean=mean))
    less = replace(data, data=data.data - np.asarray(setup.coupling @ mean))
    solutions = about_mean.condition(data.data), about_zero.condition(less.data)
    one, other = (solution.posterior for solution in solutions)
    # both means are refined to 1e-6 sigma
    assert np.abs((one.mean - mean - other.mean) / np.asarray(one.std())).max() < 1e-5
    first, second = map(residuals, solutions, (data, less))
    for part in ("instrument", "prior"):
        a, b = getattr(first.split, part), getattr(second.split, part)
        np.testing.assert_allclose([a.chi2, a.degrees], [b.chi2, b.degrees], rtol=1e-5)
    for a, b in zip(first.groups, second.groups, strict=True):
        np.testing.assert_allclose(a.chi2, b.chi2, rtol=1e-5)


FAMILY_LMAX = 5


MAKE = {
    "isotropic": lambda lmax: families.IsotropicFamily.around(2e4, lmax),
    "local scales": lambda lmax: local_scales.embedded_local_scales(25.0, lmax),
}


@pytest.fixture(scope="module", params=MAKE)
def made(request):
    """A family, and the same of a lower lmax."""
    return MAKE[request.param](FAMILY_LMAX), MAKE[request.param](3)


@pytest.fixture(scope="module")
def family(made):
    return made[0]


def somewhere(family: families.PriorFamily) -> np.ndarray:
    """Parameters away from the centre."""
    start = family.hyperprior.start()
    return start + 0.3 * np.random.default_rng(3).standard_normal(len(start))


def test_derivatives_are_those_of_the_covariance(family):
    """Central differences of step 1e-4: their error is 1e-8 of the third derivative, 1e-7 here."""
    rng, theta = np.random.default_rng(1), somewhere(family)
    n = n_modes(FAMILY_LMAX)
    half = rng.standard_normal((n, n)) / np.sqrt(np.diagonal(family.at(theta).covariance))[:, None]
    matrix, columns = half @ half.T, half[:, :2]
    member = family.at(theta)
    traces, forms = member.traces(matrix), member.forms(columns)
    for i in np.unique(np.linspace(0, len(theta) - 1, 25).astype(int)):
        step = np.zeros_like(theta)
        step[i] = 1e-4
        up, down = (family.at(theta + s).covariance for s in (step, -step))
        slope = (up - down) / 2e-4
        trace, form = (slope * matrix).sum() / 2, (columns * (slope @ columns)).sum(0) / 2
        for found, value in ((traces, trace), (forms, form)):
            np.testing.assert_allclose(found[i], value, rtol=1e-6, atol=1e-7 * np.abs(found).max())


def test_averages_are_means_over_the_parameters(family):
    """Without uncertainty S itself; with some, what each variance gains is exp(half of its own)."""
    theta = somewhere(family)
    alone = family.averaged(theta, np.zeros((len(theta),) * 2))
    np.testing.assert_allclose(alone, family.at(theta).covariance, rtol=1e-12, atol=1e-6)
    wider = family.averaged(theta, np.diag(0.5 * (np.arange(len(theta)) == 0)))
    gain = np.diagonal(wider)[1:] / np.diagonal(alone)[1:]
    assert (gain <= np.exp(0.25) * (1 + 1e-12)).all() and gain.max() > 1.01


def test_priors_of_a_family_have_its_covariance(family):
    expected = family.at(family.hyperprior.start()).covariance
    found = np.asarray(family.expected().covariance())
    np.testing.assert_allclose(found, expected, rtol=1e-10, atol=1e-8 * expected.max())


def test_the_texture_is_filtered_white_noise():
    """R sum_j w_j Y^T diag(area v_j) Y w_j R, with dense harmonics at the grid's points."""
    family = local_scales.embedded_local_scales(25.0, FAMILY_LMAX)
    member = family.at(somewhere(family))
    expected = np.zeros((n_modes(FAMILY_LMAX),) * 2)
    for band, strength in zip(family.bands, member.strengths, strict=True):
        harmonics = synthesis_matrix(*band.grid.directions(), FAMILY_LMAX)
        area = np.repeat(band.grid.weights, band.grid.n_phi)
        scale = per_mode(band.window * np.sqrt(member.spectrum))
        expected += scale[:, None] * ((harmonics.T * (area * strength)) @ harmonics) * scale
    np.testing.assert_allclose(member.texture, expected, atol=1e-11 * expected.max())


@pytest.mark.parametrize("lmax", [1, 2, 5, 31, 47])
def test_windows_share_every_ell(lmax):
    found = local_scales.windows(lmax)
    np.testing.assert_allclose((found**2).sum(0)[1:], 1.0, rtol=1e-14)
    assert (found[:, 0] == 0.0).all()


def test_the_diagonal_on_a_grid():
    """y^T C y of dense harmonics, and the adjoint of multiplication by a field."""
    rng, grid = np.random.default_rng(5), SphereGrid.of(4, 7)
    half = rng.standard_normal((25, 25))
    matrix, field = half @ half.T, rng.standard_normal(grid.shape)
    harmonics = synthesis_matrix(*grid.directions(), 4)
    dense = np.einsum("pi,ij,pj->p", harmonics, matrix, harmonics).reshape(grid.shape)
    np.testing.assert_allclose(grid.diagonal(matrix), dense, rtol=1e-12)
    area = np.asarray(grid.weights)[:, None]
    found, expected = grid.product_matrix(field) * matrix, field * area * grid.diagonal(matrix)
    np.testing.assert_allclose(found.sum(), expected.sum(), rtol=1e-11)


def test_the_hyperprior_is_a_density():
    """It integrates to one over a parameter and over a cell, and its gradient is its own."""
    theta = families.Hyperprior(np.array([-2.7]), np.array([0.2]))
    total, _ = quad(lambda x: np.exp(theta.log_density(np.array([x]))), -np.inf, np.inf)
    assert total == pytest.approx(1.0, rel=1e-6)
    cell = families.Hyperprior(np.zeros(0), np.zeros(0), 1)
    total, _ = quad(lambda x: np.exp(cell.log_density(np.array([x]))), -8.0, 60.0, limit=200)
    assert total == pytest.approx(1.0, rel=1e-6)
    both = families.Hyperprior(np.array([1.0, -2.0]), np.array([0.5, 2.0]), 2)
    at = np.array([1.4, -5.0, -0.3, 2.0])
    for i in range(4):
        step = np.zeros(4)
        step[i] = 1e-5
        slope = (both.log_density(at + step) - both.log_density(at - step)) / 2e-5
        assert both.gradient(at)[i] == pytest.approx(slope, rel=1e-7)
    assert (both.curvature(at) > 0.0).all()


def test_a_coarse_start_keeps_what_both_have(made):
    family, coarse = made
    found = family.start_from(coarse, coarse.hyperprior.start() + 0.1)
    assert len(found) == family.hyperprior.size
    assert (np.abs(found - family.hyperprior.start()) > 0.05).sum() == coarse.hyperprior.size
