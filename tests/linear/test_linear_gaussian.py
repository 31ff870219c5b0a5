"""The posterior and the evidence, by both forms, against textbook formulas and 60 digits."""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference_linear as oracle
from assertions import refuse
from jaxtyping import TypeCheckError
from scipy.stats import multivariate_normal

import lusee_bayes as lb
from lusee_bayes.instrument.coupling import DenseCoupling
from lusee_bayes.instrument.products import DataLayout
from lusee_bayes.linear import amplitudes, information
from lusee_bayes.linear.linear_gaussian import FromInformation, InData, InMap, form_of
from lusee_bayes.noise.covariance import DenseCovariance, LowRankCovariance
from lusee_bayes.noise.time_blocks import TimeBlockCovariance

FORMS = (InMap, InData, FromInformation)
LMAX, N_MODES = 3, 16
SPECTRUM = np.array([4.0, 1.0, 0.5, 0.25])
WITH_ZERO = np.array([4.0, 0.0, 0.5, 0.0])

# the accuracy that is promised, in posterior standard deviations, and for ln p absolutely
PROMISED = 1e-6
# well-scaled cases (condition below 1e4): 1e4 x 16 modes x eps = 4e-11 bounds oracle and package
WELL_SCALED = 1e-10


def per_mode(spectrum) -> np.ndarray:
    return np.concatenate([np.full(2 * ell + 1, c) for ell, c in enumerate(spectrum)])


def noise_terms(n_data: int):
    """Every structure of N over 3 products x n_data / 3 times."""
    rng, layout = np.random.default_rng(11), DataLayout(3, n_data // 3)
    diagonal = lb.DiagonalCovariance(jnp.asarray(rng.uniform(0.5, 2.0, n_data)))
    blocks = np.stack([oracle.random_covariance(rng, 3) for _ in range(layout.n_times)])
    time_blocks = TimeBlockCovariance(jnp.asarray(blocks), layout)
    dense = DenseCovariance(jnp.asarray(oracle.random_covariance(rng, n_data)))
    alone = {"diagonal": diagonal, "blocks": time_blocks, "dense": dense}
    return alone | {"diagonal+blocks": diagonal + time_blocks}


def well_scaled(n_data: int, noise="diagonal", spectrum=SPECTRUM, offset=None):
    """A model of order-one numbers and data drawn from it by numpy."""
    rng = np.random.default_rng(n_data)
    a, n = rng.normal(size=(n_data, N_MODES)), noise_terms(n_data)[noise]
    sky = rng.normal(size=N_MODES) * np.sqrt(per_mode(spectrum))
    d = a @ sky + rng.multivariate_normal(np.zeros(n_data), np.asarray(n.dense()))
    if offset is not None:
        d, offset = d + offset, jnp.asarray(offset)
    model = lb.LinearGaussian(jnp.asarray(a), lb.HarmonicPrior(jnp.asarray(spectrum)), n, offset)
    return model, jnp.asarray(d)


def naive(model, d):
    """The oracle's answer for a model with a dense A."""
    offset = 0.0 if model.offset is None else np.asarray(model.offset)
    s = np.diag(per_mode(np.asarray(model.prior.spectrum)))
    return oracle.posterior(model.coupling.dense(), s, model.noise.dense(), d, offset)


def assert_same(post, expected, tol=WELL_SCALED):
    """Mean in posterior sigma, covariance in sigma_i sigma_j, std as a ratio, ln p."""
    known = expected.std > 0
    sigma = np.where(known, expected.std, 1.0)
    assert np.abs((np.asarray(post.mean) - expected.mean) / sigma).max() < tol
    error = np.asarray(post.covariance()) - expected.covariance
    assert np.abs(error / np.outer(sigma, sigma)).max() < tol
    assert np.abs(np.asarray(post.std()) / sigma - known).max() < tol
    assert float(post.log_evidence) == pytest.approx(expected.log_prob, abs=100 * tol)


# --- the oracle itself ---------------------------------------------------------------------------


@pytest.mark.parametrize("n_data", [30, 9])
def test_oracles_agree(n_data):
    model, d = well_scaled(n_data, "dense")
    a, n = np.asarray(model.coupling.dense()), np.asarray(model.noise.dense())
    first, exact = naive(model, d), oracle.exact_posterior(a, per_mode(SPECTRUM), n, d)
    np.testing.assert_allclose(exact.mean, first.mean, atol=WELL_SCALED)
    np.testing.assert_allclose(exact.covariance, first.covariance, atol=WELL_SCALED)
    assert exact.log_prob == pytest.approx(first.log_prob, abs=WELL_SCALED)


def test_oracle_slope_is_that_of_scipys_density():
    rng = np.random.default_rng(0)
    a, d = rng.normal(size=(6, 4)), rng.normal(size=6)
    s, n, ds, dn = (oracle.random_covariance(rng, k) for k in (4, 6, 4, 6))
    h = 1e-5

    def value(x):
        return oracle.posterior(a, s + x * ds, n + x * dn, d).log_prob

    # central differences: h^2 times a third derivative of order 10, and 1e-15 / h of rounding
    slope = (value(h) - value(-h)) / (2 * h)
    assert oracle.log_prob_slope(a, s, n, d, ds, dn) == pytest.approx(slope, abs=1e-8)


# --- agreement on well-scaled cases --------------------------------------------------------------


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("n_data", [30, 9])
@pytest.mark.parametrize("noise", noise_terms(3))
def test_both_forms_equal_the_naive_oracle(noise, n_data, form):
    offset = np.linspace(-3.0, 5.0, n_data) if noise in ("blocks", "dense") else None
    model, d = well_scaled(n_data, noise, offset=offset)
    assert_same(model.condition(d, form).posterior, naive(model, d))
    # of other data, too
    for data in (3.0 * d, jnp.zeros(n_data)):
        expected = naive(model, data).log_prob
        for log_prob in (form.of(model).log_prob, model.log_prob):
            assert float(log_prob(data)) == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("n_data", [30, 9])
def test_ell_without_power_is_known_to_be_zero(n_data, form):
    model, d = well_scaled(n_data, spectrum=WITH_ZERO)
    post = model.condition(d, form).posterior
    assert_same(post, naive(model, d))
    for values in (post.mean, post.std(), post.sample(jax.random.key(0)), post.prior_fraction()):
        assert (np.asarray(values)[per_mode(WITH_ZERO) == 0] == 0.0).all()


def test_form_is_picked_from_the_sizes():
    tall, wide = well_scaled(30)[0], well_scaled(9)[0]
    assert form_of(tall) is FromInformation
    assert form_of(wide) is form_of(wide, transformed=True) is InData
    # what JAX has to transform has no closed form in NumPy
    assert form_of(tall, transformed=True) is InMap
    assert tall.factorise().basis is None
    assert wide.factorise().basis.shape == (16, 9)


def test_prior_predictive_draws_follow_the_evidence():
    model, _ = well_scaled(9, "blocks", offset=np.full(9, 2.0))
    skies, data = jax.jit(jax.vmap(model.sample))(jax.random.split(jax.random.key(4), 20_000))
    a, s = np.asarray(model.coupling.dense()), np.diag(per_mode(SPECTRUM))
    joint = np.block([[s, s @ a.T], [a @ s, a @ s @ a.T + np.asarray(model.noise.dense())]])
    mean = np.concatenate([np.zeros(16), np.full(9, 2.0)])
    oracle.assert_draws_follow(np.concatenate([skies, data], axis=1), mean, joint)


# --- the real coupling matrix --------------------------------------------------------------------


@pytest.fixture(scope="module")
def instrument():
    """A short run of the real experiment: (A, exact noise, spectrum, data)."""
    lmax = 8
    beams = lb.monopole_beams(25.0, lmax)
    coupling = lb.CouplingMatrix.observe(beams, lb.Observation.from_runs([lb.Run(0.015)]))
    assert coupling.shape == (64, 81)
    spectrum = jnp.asarray(1e8 * (1.0 + np.arange(lmax + 1.0)) ** -2.5)
    fiducial = coupling.layout.scatter(coupling @ jnp.zeros(81).at[0].set(2e4 * np.sqrt(4 * np.pi)))
    noise = lb.radiometer_noise(fiducial, coupling.layout, form="exact")
    model = lb.LinearGaussian(coupling, lb.HarmonicPrior(spectrum), noise)
    return model, model.sample(jax.random.key(3))[1]


@pytest.mark.essential
@pytest.mark.parametrize("form", FORMS)
def test_real_experiment_to_sixty_digits(instrument, form):
    """Condition number of Lambda 1e10. Reached: mean 1e-11 sigma, std 3e-10, ln p 3e-9."""
    model, d = instrument
    a = np.asarray(model.coupling.dense())
    variance = per_mode(np.asarray(model.prior.spectrum))
    exact = oracle.exact_posterior(a, variance, np.asarray(model.noise.dense()), d)
    post = model.condition(d, form).posterior
    assert np.abs((np.asarray(post.mean) - exact.mean) / exact.std).max() < 1e-9
    # A^T N^-1 A holds the condition number times eps, 2e-6, of what is known least
    lost = 2e-6 if form is FromInformation else 1e-7
    assert np.abs(np.asarray(post.std()) / exact.std - 1.0).max() < lost
    assert float(post.log_evidence) == pytest.approx(exact.log_prob, abs=10 * lost)


# --- high signal-to-noise ------------------------------------------------------------------------


def graded(n_data: int, largest: float, lmax=5, seed=1):
    """A model in which singular values of W run from 1 to ``largest``, and data of it."""
    rng, spectrum = np.random.default_rng(seed), 10.0 * np.arange(1.0, lmax + 2.0) ** -2
    prior = per_mode(spectrum)
    rank = min(n_data, len(prior))
    left = np.linalg.qr(rng.normal(size=(n_data, rank)))[0]
    right = np.linalg.qr(rng.normal(size=(len(prior), rank)))[0]
    w = left * np.logspace(0, np.log10(largest), rank) @ right.T
    variance = rng.uniform(0.5, 2.0, n_data)
    a = np.sqrt(variance)[:, None] * w / np.sqrt(prior)[None]
    d = a @ (rng.normal(size=len(prior)) * np.sqrt(prior))
    d = d + rng.normal(size=n_data) * np.sqrt(variance)
    harmonic, noise = (lb.HarmonicPrior(jnp.asarray(spectrum)), lb.DiagonalCovariance(variance))
    model = lb.LinearGaussian(jnp.asarray(a), harmonic, noise)
    return model, jnp.asarray(d), oracle.exact_posterior(a, prior, np.diag(variance), d)


# What float64 reaches, with ten times to spare. The mean is refined, so all forms keep it to
# eps x largest, and through the information, whose gradient is in 1/K and has to be coloured by
# the prior and whitened again, to three times that. The Cholesky factor of 1 + W^T W has absolute
# errors eps x largest^2 where Lambda may be 1: std and ln p of the forms on the sky's side lose
# that much. The data form's triangle is graded, rows of
# every size keep their own relative accuracy, and it loses only eps x largest.
@pytest.mark.essential
@pytest.mark.parametrize("largest", [1e2, 1e4, 1e6])
@pytest.mark.parametrize("n_data", [60, 24])
@pytest.mark.parametrize("form", FORMS)
def test_high_signal_to_noise_to_sixty_digits(form, n_data, largest):
    model, d, exact = graded(n_data, largest)
    post, eps = model.condition(d, form).posterior, np.finfo(float).eps
    linear, squared = 1e-13 + 10 * eps * largest, 1e-12 + 10 * eps * largest**2
    lost = squared if form is not InData else linear
    refined = linear if form is not FromInformation else 3 * linear
    assert np.abs((np.asarray(post.mean) - exact.mean) / exact.std).max() < refined
    assert np.abs(np.asarray(post.std()) / exact.std - 1.0).max() < lost
    assert float(post.log_evidence) == pytest.approx(exact.log_prob, abs=10 * lost)
    assert float(post.refinement) <= information.CONVERGENCE


def test_refinement_is_needed_and_reported():
    """Without refinement the normal equations' mean is off by more than is promised."""
    model, d, exact = graded(60, 1e6)
    solver = model.factorise(InMap)
    lower = np.tril(np.asarray(solver.lower))
    pulled = model.prior.colour(solver.whitened.T @ (d / np.sqrt(model.noise.variance)))
    u = np.linalg.solve(lower.T, np.linalg.solve(lower, np.asarray(pulled)))
    unrefined = u * np.sqrt(per_mode(np.asarray(model.prior.spectrum)))
    assert np.abs((unrefined - exact.mean) / exact.std).max() > PROMISED
    assert 0.0 <= float(model.condition(d, InMap).posterior.refinement) <= information.CONVERGENCE


@pytest.mark.parametrize("n_data", [30, 9])
def test_no_convergence_is_an_error(n_data):
    """An L that is twice too large: the error shrinks by 3/4 per step, 0.06 after ten."""
    model, d = well_scaled(n_data)
    solver = model.factorise()
    solver = eqx.tree_at(lambda s: s.lower, solver, 2.0 * solver.lower)
    for ask in (solver.condition, solver.log_prob):
        refuse("did not converge", ask, d)


def test_noise_too_small_for_float64_is_an_error():
    """W from 1 to 1e9: Lambda holds 1 and 1e18, of which eps is 200."""
    model, d, exact = graded(24, 1e9)
    refuse("no Cholesky factor|not converge", model.condition, d, InMap)
    post = model.condition(d, InData).posterior  # the graded form still gets there
    assert np.abs((np.asarray(post.mean) - exact.mean) / exact.std).max() < PROMISED


# --- gradients and transformations ---------------------------------------------------------------


def log_prob_of(model, d):
    def value(spectrum, level):
        noise = model.noise.scaled(level)
        return lb.LinearGaussian(model.coupling, lb.HarmonicPrior(spectrum), noise).log_prob(d)

    return value


def expected_slopes(model, d):
    """d ln p / d C_ell and d ln p / d (noise level) by the textbook formula."""
    a, n = np.asarray(model.coupling.dense()), np.asarray(model.noise.dense())
    s, y = np.diag(per_mode(np.asarray(model.prior.spectrum))), np.asarray(d)
    shapes = [np.diag(per_mode(one)) for one in np.eye(LMAX + 1)]
    of_ell = [oracle.log_prob_slope(a, s, n, y, shape, 0 * n) for shape in shapes]
    return np.array(of_ell), oracle.log_prob_slope(a, s, n, y, 0 * s, n)


@pytest.mark.parametrize("derivative", [jax.jacfwd, jax.grad])
@pytest.mark.parametrize("n_data", [30, 9])
def test_slopes_of_the_evidence(derivative, n_data):
    model, d = well_scaled(n_data, "dense")
    got = derivative(log_prob_of(model, d), argnums=(0, 1))(jnp.asarray(SPECTRUM), jnp.asarray(1.0))
    of_ell, of_level = expected_slopes(model, d)
    np.testing.assert_allclose(got[0], of_ell, rtol=1e-9, atol=1e-9)
    assert float(got[1]) == pytest.approx(of_level, rel=1e-9)


def test_evidence_inside_jit_and_vmap():
    model, d = well_scaled(30)
    value, levels = log_prob_of(model, d), jnp.array([0.5, 1.0, 4.0])
    got = jax.jit(jax.vmap(value, (None, 0)))(jnp.asarray(SPECTRUM), levels)
    for level, log_prob in zip(levels, got, strict=True):
        scaled = lb.LinearGaussian(model.coupling, model.prior, model.noise.scaled(float(level)))
        assert float(log_prob) == pytest.approx(naive(scaled, d).log_prob, abs=1e-9)


# --- refusals ------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def small():
    return well_scaled(9)


@pytest.mark.parametrize("form", FORMS)
def test_a_solution_keeps_its_data(small, form):
    model, data = small[0], np.array(small[1])
    solution, sky = model.condition(data, form), np.zeros(16)
    chi2 = solution.chi2
    refuse("the data has shape", model.chi2, sky, data[:1])
    data[:] = 1e6
    assert solution.chi2 == chi2


@pytest.mark.parametrize("form", FORMS)
def test_bad_data_are_refused(small, form):
    model, d = small
    for bad, message in (
        (d[:-1], r"the data has shape \(8,\), expected \(9,?\)"),
        (d.at[4].set(jnp.nan), r"the data.*NaN or infinity \(1 of 9 .*\(4,\)"),
        (d.astype(jnp.float32), r"the data must be a float64 array, got .*float32"),
        (np.ma.array(np.asarray(d), mask=np.arange(9) == 2), "the data has a mask"),
    ):
        for ask in (lambda x: model.condition(x, form).posterior, model.log_prob):
            refuse(message, ask, bad)


def test_bad_parts_are_refused(small):
    model, d = small
    a, prior, noise = model.coupling.dense(), model.prior, model.noise
    for given, words in (
        ((a[:8], prior, noise), "coupling matrix has 8 rows, the noise covariance 9"),
        ((a, lb.HarmonicPrior(jnp.ones(3)), noise), "A has 16 columns, the prior 9 .* lmax"),
        ((a.at[2, 3].set(jnp.nan), prior, noise), r"coupling matrix.*NaN .*\(2, 3\)"),
        ((a.astype(jnp.float32), prior, noise), "coupling matrix must be a float64 array"),
        ((a, prior, noise, jnp.full(9, jnp.nan)), "the offset.*NaN"),
    ):
        refuse(words, lb.LinearGaussian, *given)
    with pytest.raises((lb.InputError, TypeCheckError), match="offset"):  # types are checked first
        lb.LinearGaussian(a, prior, noise, jnp.ones(8))
    bad = DenseCovariance(jnp.eye(9).at[0, 0].set(-2.0), "the gain term")
    refuse("gain term.*not positive definite.* -2 ", lb.LinearGaussian(a, prior, bad).condition, d)


def test_slopes_with_fewer_data_and_an_ell_without_power():
    spectrum = np.array([4.0, 1.0, 0.0, 0.0])  # 4 modes are left, fewer than the 9 data
    model, d = well_scaled(9, spectrum=spectrum)
    added = jnp.linspace(0.0, 1.0, 9)

    def value(x):
        noise = lb.DiagonalCovariance(model.noise.variance + x * added)
        return lb.LinearGaussian(model.coupling, model.prior, noise).log_prob(d)

    a, s, n = model.coupling.dense(), np.diag(per_mode(spectrum)), model.noise.dense()
    a, n, added_n = np.asarray(a), np.asarray(n), np.diag(np.asarray(added))
    expected = oracle.log_prob_slope(a, s, n, np.asarray(d), 0 * s, added_n)
    assert float(jax.jit(jax.jacfwd(value))(jnp.asarray(0.0))) == pytest.approx(expected, rel=1e-9)


def test_standard_deviations_are_right_or_refused():
    model, d, exact = graded(24, 5e7)
    try:
        std = np.asarray(model.condition(d, InMap).posterior.std())
    except lb.InputError:
        return
    assert np.abs(std / exact.std - 1.0).max() < 1e-3  # 3e-2 is what comes


BESIDE = [(0, 3, 1.0), (2, 3, 1.0), (2, 3, 1.01), (2, 0, 1.0)]


@pytest.mark.parametrize(("before", "after", "gain"), BESIDE)
def test_beside_a_solved_model_columns_are_changed(before, after, gain):
    """A^T N^-1 A of one N_0 + U U^T from that of another: the textbook's posterior.

    With another A it is not used.
    """
    model, d = well_scaled(30, "blocks")
    rng = np.random.default_rng(6)

    def with_columns(n: int) -> lb.LinearGaussian:
        update = LowRankCovariance(jnp.asarray(rng.normal(size=(30, n))))
        return replace(model, noise=model.noise + update) if n else model

    known, wanted = with_columns(before).condition(d), with_columns(after)
    wanted = replace(wanted, coupling=DenseCoupling(gain * wanted.coupling.dense()))
    found = FromInformation.beside(known, wanted).condition(d)
    expected = oracle.posterior(*oracle.matrices(wanted), d)
    assert np.abs((found.posterior.mean - expected.mean) / expected.std).max() < WELL_SCALED
    np.testing.assert_allclose(found.covariance, expected.covariance, atol=1e-10)
    assert float(found.posterior.log_evidence) == pytest.approx(expected.log_prob, abs=1e-9)


@pytest.mark.parametrize("size", [0.5, 3.0])
def test_the_variance_of_columns_is_where_the_density_of_data_is_largest(size):
    """ln p(d | s) - ln^2 s / (2 std^2) of dense matrices, on a grid of s."""
    rng, n = np.random.default_rng(6), 40
    a, u = rng.normal(size=(n, N_MODES)), rng.normal(size=(n, 12))
    s, noise = np.diag(per_mode(SPECTRUM)), np.diag(rng.uniform(0.5, 2.0, n))
    signal = a @ np.linalg.cholesky(s) @ rng.normal(size=N_MODES) + size * u @ rng.normal(size=12)
    data = signal + np.sqrt(np.diag(noise)) * rng.normal(size=n)
    base = lb.DiagonalCovariance(jnp.asarray(np.diag(noise))) + LowRankCovariance(jnp.asarray(u))
    model = lb.LinearGaussian(jnp.asarray(a), lb.HarmonicPrior(jnp.asarray(SPECTRUM)), base)
    found = amplitudes.template_amplitudes(model.condition(jnp.asarray(data)), u)
    factors, known = np.exp(np.linspace(-2.9, 2.9, 101)), a @ s @ a.T + noise
    tried = [multivariate_normal.logpdf(data, cov=known + f * u @ u.T) for f in factors]
    for std in (0.3, 10.0):
        best = int(np.argmax(np.array(tried) - 0.5 * (np.log(factors) / std) ** 2))
        assert factors[best - 1] < amplitudes.variance_factor(found, std) < factors[best + 1]
    # twelve columns tell their variance to 40 %; a narrow prior keeps it near one
    assert 0.4 < amplitudes.variance_factor(found, 10.0) / size**2 < 2.5
    assert abs(np.log(amplitudes.variance_factor(found, 0.3) / size**2)) > 0.1
