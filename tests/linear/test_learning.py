"""Learning a prior's parameters against brute-force maximisation, and draws with their errors."""

from dataclasses import dataclass, replace

import jax
import numpy as np
import pytest
from assertions import refuse
from jaxtyping import TypeCheckError
from scipy import integrate, special, stats
from scipy.optimize import minimize

import lusee_bayes as lb
from lusee_bayes.linear.compressed import Compressed
from lusee_bayes.linear.information import Information, integrated_out
from lusee_bayes.priors import learning, local_scales
from lusee_bayes.priors.families import FREEDOM, Hyperprior, IsotropicFamily
from lusee_bayes.sky.prior import DensePrior

LMAX, N_DATA = 6, 120


def information_of(sky, noise=30.0, seed=2, n_data=N_DATA, strength=1.0, seen=None) -> Information:
    """Of data of a sky, or of its first modes, through a random A."""
    rng = np.random.default_rng(seed)
    coupling = strength * rng.standard_normal((n_data, len(sky))) / np.sqrt(len(sky))
    coupling[:, len(sky) if seen is None else seen :] = 0.0
    data = coupling @ sky + noise * rng.standard_normal(n_data)
    prior = lb.HarmonicPrior(np.full(round(np.sqrt(len(sky))), 1e8))
    variance = lb.DiagonalCovariance(np.full(n_data, noise**2))
    return lb.LinearGaussian(coupling, prior, variance).condition(data).information


@dataclass(frozen=True)
class Case:
    family: IsotropicFamily
    information: Information
    truth: np.ndarray


@pytest.fixture(scope="module")
def case() -> Case:
    family = IsotropicFamily.around(2e4, LMAX)
    rng, truth = np.random.default_rng(1), family.hyperprior.start()
    truth[:2] += [0.7, -0.3]
    sky = np.asarray(family.prior(family.at(truth).covariance).sample(jax.random.key(4)))
    return Case(family, information_of(np.array(sky), seed=int(rng.integers(100))), truth)


def log_density(case: Case, theta: np.ndarray) -> float:
    """ln p(d, theta), by the posterior's own evidence."""
    prior = case.family.prior(case.family.at(theta).covariance)
    evidence = float(case.information.posterior(prior).log_evidence)
    return evidence + case.family.hyperprior.log_density(theta)


def test_the_maximum_is_that_of_a_general_optimiser(case):
    """Nelder-Mead knows no gradient; ln p there and here agree to what is said to be settled."""
    found = learning.learn(case.family, case.information)
    start = case.family.hyperprior.start()
    options = {"xtol": 1e-4, "ftol": 1e-9, "maxiter": 200}
    other = minimize(lambda x: -log_density(case, x), start, method="Powell", options=options)
    assert log_density(case, found.parameters) > -other.fun - 0.05
    std = np.sqrt(np.diagonal(found.covariance))
    assert np.abs(found.parameters - other.x).max() < 0.5 * std.max()
    assert (np.abs(found.parameters - case.truth) < 4.0 * std).all()


def test_the_curvature_is_that_of_the_evidence(case):
    """The expected curvature and the one at these data differ by their scatter: factor of two."""
    found = learning.learn(case.family, case.information)
    for i in (0, len(found.parameters) - 1):
        step = np.zeros(len(found.parameters))
        step[i] = 0.1
        values = [log_density(case, found.parameters + s) for s in (step, 0.0 * step, -step)]
        curvature = -(values[0] - 2.0 * values[1] + values[2]) / 0.01
        assert 0.5 < curvature / np.linalg.inv(found.covariance)[i, i] < 2.0


def test_learning_gains_over_the_start_under_local_scales():
    """A sky of a strong plane is told from one without it."""
    family = local_scales.embedded_local_scales(25.0, LMAX)
    theta = family.hyperprior.start()
    sky = np.asarray(family.prior(family.at(theta).covariance).sample(jax.random.key(7)))
    information = information_of(sky)
    found = learning.learn(family, information)
    before = float(information.posterior(family.expected()).log_evidence)
    assert float(information.posterior(found.prior).log_evidence) > before - 1.0
    assert np.isfinite(found.log_evidence)
    # the variances' means are at the level that suits the data best: another is less probable
    mean, about = family.hyperprior.moments(found.scores.mean, found.scores.covariance)

    def evidence(shift):
        prior = family.prior(family.averaged(mean + shift * (np.arange(len(mean)) == 0), about))
        return float(information.posterior(prior).log_evidence)

    best = float(information.posterior(found.prior).log_evidence)
    assert evidence(0.0) == pytest.approx(best, abs=0.01)
    assert max(evidence(-0.4), evidence(0.4)) < best
    assert [row["name"] for row in found.as_rows()] == list(family.names)


def test_a_texture_that_data_only_limit_is_as_strong_as_they_allow():
    """Its level is ln of the mean variance over its posterior, here on a finer and longer grid."""
    family = local_scales.embedded_local_scales(25.0, LMAX)
    information = information_of(1.02 * family.mean)
    found = learning.learn_whatever_fits(family, information)
    assert found.settled and found.noise_factor == 1.0
    mean, about = family.hyperprior.moments(found.scores.mean, found.scores.covariance)
    first = np.arange(len(mean)) == 0

    def evidence(shift):
        prior = family.prior(family.averaged(mean + shift * first, about))
        return float(information.posterior(prior).log_evidence)

    shifts = np.arange(-12.0, 8.0, 0.5)
    log_p = [evidence(by) + family.hyperprior.log_density(mean + by * first) for by in shifts]
    assert abs(special.logsumexp(log_p + shifts) - special.logsumexp(log_p)) < 0.7
    # the data hardly care whether there is any
    assert abs(evidence(0.0) - evidence(-300.0)) < 2.0


def test_parameters_too_uncertain_to_be_averaged_have_their_most_probable_values(case, monkeypatch):
    def infinite(*_):
        raise lb.InputError("too large")

    monkeypatch.setattr(IsotropicFamily, "averaged", infinite)
    found = learning.learn(case.family, case.information)
    most_probable = case.family.at(found.parameters).covariance
    np.testing.assert_allclose(found.prior.variance(), np.diagonal(most_probable), rtol=1e-12)
    assert found.scores.covariance.max() < 1e-5 and not found.averaged


def test_variances_beyond_the_data_are_means_over_parameters(case):
    scores = learning.learn(case.family, case.information).scores
    wider, rng, n = IsotropicFamily.around(2e4, 3 * LMAX), np.random.default_rng(3), 40_000
    known = wider.start_from(case.family, np.ones(len(scores.mean))) > 0
    drawn = rng.standard_normal((n, len(known)))
    drawn[:, known] = rng.multivariate_normal(scores.mean, scores.covariance, n)
    each = np.exp(wider.hyperprior.near(np.where(known, drawn.mean(0), 0.0), drawn) @ wider.basis.T)
    got = np.diagonal(learning.averaged_beyond(wider, case.family, scores))[np.arange(19) ** 2]
    assert (np.abs(each.mean(0) - got) <= 4.5 * each.std(0) / np.sqrt(n)).all()


def test_others_integrated_out(case):
    """The evidence of the first modes alone, with the others' prior in it, is that of all."""
    spectrum = np.geomspace(1e8, 1e5, LMAX + 1)
    mean = np.asarray(lb.HarmonicPrior(spectrum).sample(jax.random.key(1)))
    prior = lb.HarmonicPrior(spectrum, mean=mean)
    everything, n = case.information.posterior(prior), 16
    few = integrated_out(case.information, n, np.asarray(prior.variance())[n:], mean[n:])
    found = few.posterior(lb.HarmonicPrior(spectrum[:4], mean=mean[:n]))
    assert float(found.log_evidence) == pytest.approx(float(everything.log_evidence), abs=1e-6)
    np.testing.assert_allclose(found.mean, everything.mean[:n], rtol=1e-7, atol=1e-4)
    np.testing.assert_allclose(found.std(), everything.std()[:n], rtol=1e-7)
    with pytest.raises((lb.InputError, TypeCheckError)):
        integrated_out(case.information, n, np.ones(3))


def test_nothing_settles_without_steps(case, monkeypatch):
    monkeypatch.setattr("lusee_bayes.priors.learning.MAX_STEPS", 0)
    refuse("not converge.*0 steps", learning.learn, case.family, case.information)
    # a family far from its own start is still found
    far = replace(case.family.hyperprior, centre=case.truth + 0.5 * case.family.hyperprior.width)
    monkeypatch.undo()
    found = learning.learn(replace(case.family, hyperprior=far), case.information).parameters
    assert (found != far.start()).any()


def test_data_without_information_leave_the_parameters_as_they_were(case):
    names = ("matrix", "vector", "misfit", "log_det")
    empty = {name: np.zeros_like(getattr(case.information, name)) for name in names}
    found = learning.learn(case.family, case.information.altered(**empty))
    np.testing.assert_array_equal(found.parameters, case.family.hyperprior.start())
    assert found.log_evidence == pytest.approx(-0.5 * N_DATA * np.log(2.0 * np.pi), abs=1e-9)


def test_compressed_data_have_the_evidence_and_the_posterior_of_all():
    """Of the density of d itself; modes that the data hardly see need no numbers of their own."""
    rng, n, seen = np.random.default_rng(7), (LMAX + 1) ** 2, 30
    coupling = rng.standard_normal((N_DATA, n)) * np.where(np.arange(n) < seen, 1.0, 1e-8)
    variance = rng.uniform(1.0, 2.0, N_DATA)
    root = np.tril(rng.standard_normal((n, n))) + 5.0 * np.eye(n)
    prior = DensePrior(root, mean=100.0 * rng.standard_normal(n))
    data = coupling @ (prior.mean + 20.0 * rng.standard_normal(n))
    model = lb.LinearGaussian(coupling, prior, lb.DiagonalCovariance(variance))
    compressed = Compressed.of(model.condition(data).information, prior.mean, np.full(n, 50.0))
    assert len(compressed.data) == seen
    of_data = stats.multivariate_normal(
        coupling @ prior.mean, coupling @ root @ root.T @ coupling.T + np.diag(variance)
    )
    lower = compressed.root(compressed.covariance(prior))
    assert compressed.log_evidence(lower) == pytest.approx(of_data.logpdf(data), abs=1e-6)
    # the posterior by its textbook formula; 49 whitened means and variances of 4000 draws
    gain = root @ root.T @ coupling.T @ np.linalg.inv(of_data.cov)
    mean = prior.mean + gain @ (data - of_data.mean)
    about = root @ root.T - gain @ coupling @ root @ root.T
    draws = compressed.sample(prior, jax.random.key(3), 4000)
    white = np.linalg.solve(np.linalg.cholesky(about), (draws - mean).T)
    assert np.abs(white.mean(1)).max() < 4.5 / np.sqrt(4000)
    assert np.abs(np.cov(white) - np.eye(n)).max() < 5.0 * np.sqrt(2.0 / 4000)


# --- normal scores --------------------------------------------------------------------------------


@pytest.mark.long
def test_the_evidence_agrees_with_draws_of_the_hyperprior():
    """The mean of p(d | theta) over theta ~ p(theta), which no maximum enters."""
    family = IsotropicFamily.around(2e4, 4)
    prior = family.prior(family.at(family.hyperprior.start()).covariance)
    sky = np.asarray(prior.sample(jax.random.key(4)))
    information = information_of(sky, noise=2000.0, seed=3, n_data=40, strength=5.0 / 3.0)
    hyperprior, rng = family.hyperprior, np.random.default_rng(5)
    drawn = hyperprior.centre + hyperprior.width * rng.standard_t(FREEDOM, (1000, hyperprior.size))
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
    assert abs(learning.learn(family, information).log_evidence - expected) < 0.6


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
        slopes = rise / (2.0 * step)
        np.testing.assert_allclose(hyperprior.slopes_of_scores(both), slopes, rtol=1e-7)


def test_an_unseen_cell_has_the_factor_that_is_expected_of_it():
    """Mean and variance of ln v against a gamma variable's; theta is linear in its score."""
    hyperprior = Hyperprior(np.array([1.0]), np.array([0.5]), n_cells=1)
    mean, covariance = hyperprior.moments(np.zeros(2), np.diag([0.01, 1.0]))
    shape, slope = 0.75, hyperprior.slopes_of_scores(np.zeros(2))[0]
    np.testing.assert_allclose(mean, [1.0, 0.5 * (np.log(shape) - special.digamma(shape))], 1e-3)
    variances = [0.01 * slope**2, 0.25 * special.polygamma(1, shape)]
    np.testing.assert_allclose(np.diagonal(covariance), variances, rtol=1e-2)
    # theta is linear, the cell is what its score says
    two = np.full(2, 2.0)
    expected = [1.0 + 2.0 * slope, hyperprior.of_scores(two)[1]]
    np.testing.assert_allclose(hyperprior.near(np.zeros(2), two), expected)


# --- data that do not fit -------------------------------------------------------------------------


def test_raised_information_is_that_of_raised_noise():
    """Of the same data under N times a factor."""
    rng, n = np.random.default_rng(3), (LMAX + 1) ** 2
    coupling, data = rng.standard_normal((N_DATA, n)), 100.0 * rng.standard_normal(N_DATA)
    prior = lb.HarmonicPrior(np.full(LMAX + 1, 1e4))
    noise = (lb.DiagonalCovariance(np.full(N_DATA, variance)) for variance in (9.0, 63.0))
    models = (lb.LinearGaussian(coupling, prior, n) for n in noise)
    plain, expected = (model.condition(data).information for model in models)
    raised, sky = plain.raised(7.0), rng.standard_normal(n)
    np.testing.assert_allclose(raised.matrix, expected.matrix, rtol=1e-12)
    assert float(raised.chi2(sky)) == pytest.approx(float(expected.chi2(sky)), rel=1e-10)
    assert float(raised.log_det) == pytest.approx(float(expected.log_det), rel=1e-12)


def test_data_that_fit_demand_nothing(case):
    """And the prior is that of learning without a question asked."""
    assert learning.demanded_factor(case.information, case.family.expected()) == 1.0
    plain = learning.learn(case.family, case.information)
    found = learning.learn_whatever_fits(case.family, case.information)
    assert found.settled and found.noise_factor == 1.0
    np.testing.assert_array_equal(found.parameters, plain.parameters)


def test_what_no_sky_explains_raises_n(case):
    """chi^2 of everything 50 times as large: N is raised by that."""
    bad = replace(case.information, misfit=np.asarray(50.0 * case.information.misfit))
    factor = learning.demanded_factor(bad, case.family.expected())
    assert 30.0 < factor < 80.0
    assert learning.learn_whatever_fits(case.family, bad).noise_factor >= factor > 1.0


def test_where_nothing_settles_the_prior_is_fixed_and_wide(case, monkeypatch):
    monkeypatch.setattr("lusee_bayes.priors.learning.MAX_STEPS", 0)
    found = learning.learn_whatever_fits(case.family, case.information)
    assert not found.settled and found.as_rows() == []
    ratio = np.asarray(found.prior.variance()) / np.asarray(case.family.expected().variance())
    np.testing.assert_allclose(ratio, ratio[0], rtol=1e-10)
    assert ratio[0] >= 1.0
    evidence = float(case.information.posterior(found.prior).log_evidence)
    assert found.log_evidence == pytest.approx(evidence, rel=1e-12)


# --- draws with uncertain parameters --------------------------------------------------------------


LOW = 3
SIZE = (LOW + 1) ** 2


@dataclass(frozen=True)
class Member:
    covariance: np.ndarray


SCALE = 1e3


PRIOR = Hyperprior(np.array([0.4]), np.array([1.0]))


class Strength(IsotropicFamily):
    """S = exp(theta) s^2 1."""

    def at(self, parameters):
        return Member(np.exp(parameters[0]) * SCALE**2 * np.eye(SIZE))

    def prior(self, covariance):
        return lb.HarmonicPrior(np.diagonal(covariance)[np.arange(LOW + 1) ** 2])


def scores_of(hyperprior, theta, covariance) -> learning.Scores:
    """Those whose parameters are normal about theta, with this covariance."""
    z = hyperprior.scores(theta)
    slope = hyperprior.slopes_of_scores(z)
    return learning.Scores(z, covariance / slope[:, None] / slope, 0.0)


def test_draws_are_those_of_the_integral_over_the_parameter():
    """Every mode: the distribution function at some points, by quadrature over theta.

    Modes are seen with noise from a tenth to ten times their strength; theta = 0.4 +- 1.
    """
    family, width = Strength(np.ones((LOW + 1, 1)), PRIOR), 1.0
    noise = np.geomspace(0.1, 10.0, SIZE) * SCALE
    seen, unknown = 2.0 * SCALE * np.ones(SIZE), [np.asarray(0.0)] * 3
    information = Information(np.diag(noise**-2.0), seen / noise**2, np.zeros(SIZE), *unknown)
    prior = family.prior(family.at(np.array([0.4])).covariance)
    theta, covariance = np.array([0.4]), np.array([[width**2]])
    scores = scores_of(family.hyperprior, theta, covariance)
    learned = learning.Learned(prior, theta, covariance, scores, 0.0)
    draws = learning.draws_with_parameters(family, learned, information, jax.random.key(1), 4500)
    assert draws.shape == (4500, SIZE)

    theta = np.linspace(-6.0, 7.0, 2001)
    density = stats.norm.pdf(theta, 0.4, 1.0)
    for k in (0, SIZE // 2, SIZE - 1):
        weight = 1.0 / (1.0 + noise[k] ** 2 / (np.exp(theta) * SCALE**2))
        for level in (0.02, 0.2, 0.5, 0.8, 0.98):
            at = np.quantile(draws[:, k], level)
            below = stats.norm.cdf(at, weight * seen[k], np.sqrt(weight) * noise[k])
            expected = integrate.simpson(below * density, x=theta)
            scatter = integrate.simpson((below - expected) ** 2 * density, x=theta)
            # 150 theta, each for 30 draws
            assert abs(level - expected) < 4.0 * np.sqrt(scatter / 150 + level * (1 - level) / 4500)


def weakly_known(family: IsotropicFamily, std: float) -> tuple[learning.Learned, Information]:
    """Parameters known to so much, and the information of data that hardly tell the sky."""
    theta = family.hyperprior.start()
    prior = family.prior(family.at(theta).covariance)
    matrix, one = np.eye(SIZE) * 1e-8, np.ones(())
    information = Information(matrix, np.ones(SIZE), np.zeros(SIZE), one, one, one)
    covariance = std**2 * np.eye(len(theta))
    scores = scores_of(family.hyperprior, theta, covariance)
    return learning.Learned(prior, theta, covariance, scores, 0.0), information


def test_few_draws_and_none():
    family = IsotropicFamily.around(2e4, LOW)
    given = (family, *weakly_known(family, 0.3), jax.random.key(1))
    drawn = [learning.draws_with_parameters(*given, n) for n in (0, 1, 7)]
    assert [len(one) for one in drawn] == [0, 1, 7]
    assert len(np.unique(drawn[2], axis=0)) == 7


class Hopeless(Strength):
    """No theta has an S."""

    def prior(self, covariance):
        raise lb.InputError("it has no root")


def test_parameters_without_a_covariance_are_drawn_anew_and_then_refused():
    plain, hopeless = (kind(np.ones((LOW + 1, 1)), PRIOR) for kind in (Strength, Hopeless))
    given = hopeless, *weakly_known(plain, 1.0), jax.random.key(1), 3
    words = "cannot draw skies with uncertain prior parameters"
    refuse(words, learning.draws_with_parameters, *given)


def test_a_level_that_only_the_tilt_makes_uncertain_is_learned():
    """Data up to ell = 3 and any tilt: the level, at ell = 9, is uncertain by more than a factor e.

    What is measured keeps its size, and what is not gets the mean variance of the possible tilts.
    """
    family, seen = IsotropicFamily.around(2e4, 12), 16
    width = np.full(family.hyperprior.size, 1e-3)
    width[:2] = family.hyperprior.width[0], 2.0
    family = replace(family, hyperprior=replace(family.hyperprior, width=width))
    expected = family.at(family.hyperprior.start()).covariance.diagonal()
    sky = np.sqrt(expected) * np.random.default_rng(3).choice([-1.0, 1.0], len(expected))
    found = learning.learn(family, information_of(sky, seen=seen))
    assert found.covariance[0, 0] > 1.0
    learned = found.prior.covariance().diagonal()
    # one of sqrt(2 / 15): of the squares of 15 modes
    assert np.abs(np.log(learned[1:seen] / expected[1:seen])).max() < 1.0
    assert (learned[100:] > 1.3 * family.at(found.parameters).covariance.diagonal()[100:]).all()
