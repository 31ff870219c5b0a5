"""``compare``: draws of a known posterior pass, a posterior that is wrong does not.

Draws are made by numpy, with the textbook's dense mean and covariance, not by the solver.
"""

import jax.numpy as jnp
import numpy as np
import pytest
from assertions import failed, refuse
from scipy import linalg, stats

import lusee_bayes as lb
from lusee_bayes.linear.linear_gaussian import Form, InData, InMap
from lusee_bayes.linear.posterior import Posterior
from lusee_bayes.noise.covariance import DenseCovariance
from lusee_bayes.sampling import validation

LMAX, MODES = 3, 16
CHAINS, DRAWS = 4, 500
TOTAL = CHAINS * DRAWS
COVARIANCE = {"covariance, smallest", "covariance, largest"}
# angles (in units of pi) by which trajectories turn: at random, mostly more than a right angle
# (as NUTS chooses them, so that means are better than those of independent draws), or by little
TURNS = {"independent": (0.5, 0.5), "like NUTS": (0.5, 1.0), "slow": (0.1, 0.14)}


def chains(seed: int, turns: str, draws: int = DRAWS):
    """White exact chains x' = c x + s p with their energies, begun in equilibrium."""
    rng = np.random.default_rng(seed)
    white, energy = np.empty((CHAINS, draws, MODES)), np.empty((CHAINS, draws))
    x = rng.standard_normal((CHAINS, MODES))
    for t in range(draws):
        p = rng.standard_normal((CHAINS, MODES))
        energy[:, t] = 0.5 * (x**2 + p**2).sum(1)
        angle = np.pi * rng.uniform(*TURNS[turns], (CHAINS, 1))
        x = np.cos(angle) * x + np.sin(angle) * p
        white[:, t] = x
    return white, energy


class Truth:
    """A small model with correlated unknowns, conditioned by the package and by the textbook."""

    def __init__(self, form: type[Form]):
        rng, n_data = np.random.default_rng(5), 40 if form is InMap else 10
        spectrum = np.array([100.0, 4.0, 1.0, 0.01])
        s = np.diag(np.repeat(spectrum, 2 * np.arange(LMAX + 1) + 1))
        a = rng.standard_normal((n_data, MODES))
        root = rng.standard_normal((n_data, 2 * n_data))
        n = 30.0 * root @ root.T / n_data
        data = a @ np.sqrt(s) @ rng.standard_normal(MODES)
        data = data + np.linalg.cholesky(n) @ rng.standard_normal(n_data)
        gain = s @ a.T @ np.linalg.inv(a @ s @ a.T + n)
        self.mean, self.covariance = gain @ data, s - gain @ a @ s
        self.root = np.linalg.cholesky(self.covariance)
        self.std = np.sqrt(np.diag(self.covariance))
        prior, noise = lb.HarmonicPrior(jnp.asarray(spectrum)), DenseCovariance(jnp.asarray(n))
        model = lb.LinearGaussian(jnp.asarray(a), prior, noise)
        self.posterior = model.condition(jnp.asarray(data), form).posterior

    def draws(self, seed: int, turns: str = "like NUTS", draws: int = DRAWS):
        white, energy = chains(seed, turns, draws)
        return self.mean + white @ self.root.T, energy


def wrong_posterior(mean: np.ndarray, covariance: np.ndarray) -> Posterior:
    """N(mean, covariance), whatever they are: the prior is one, Lambda the covariance's inverse."""
    lower = np.linalg.cholesky(np.linalg.inv(covariance))
    prior, zero = lb.HarmonicPrior(jnp.ones(LMAX + 1)), jnp.zeros(())
    return Posterior(prior, jnp.asarray(mean), jnp.asarray(lower), None, zero, zero)


def judge(draws, energy, posterior, diverging=None, seed=0):
    diverging = np.zeros(energy.shape, bool) if diverging is None else diverging
    return validation.validate_draws(draws, posterior, diverging, energy, seed=seed)


@pytest.fixture(scope="module")
def truth():
    return Truth(InMap)


# --- exact draws pass -------------------------------------------------------------------------


@pytest.mark.long
@pytest.mark.parametrize(("form", "turns"), [(InMap, "independent"), (InData, "like NUTS")])
def test_false_alarms_are_as_rare_as_stated(form, turns):
    """500 runs of three comparisons: 1.5 expected, 6 or more once in 200 tests."""
    truth = Truth(form)
    alarms = [failed(judge(*truth.draws(seed, turns), truth.posterior)) for seed in range(500)]
    assert sum(map(bool, alarms)) < 6, [a for a in alarms if a]


TURNING = [pytest.param("independent", marks=pytest.mark.long), "like NUTS"]


@pytest.mark.parametrize("turns", TURNING)
def test_scores_of_means_and_variances_are_standard_normal(turns):
    """30 runs of 16 uncorrelated modes: a scale of the scores that is off by a sixth is seen."""
    mean, scale = np.linspace(-1, 1, MODES), 10.0 ** np.linspace(-2, 2, MODES)
    posterior = wrong_posterior(mean, np.diag(scale**2))
    means, variances = [], []
    for seed in range(30):
        white, energy = chains(seed, turns, 300)
        found = judge(mean + white * scale, energy, posterior)
        means.append(found.mean_z)
        variances.append(validation._chi2_z(found.variance_ratio, 2 / found.variance_error**2))
    for z in (np.concatenate(means), np.concatenate(variances)):
        assert stats.kstest(z, "norm").pvalue > 1e-3
        # chi^2 of 480 scores, five sigma
        assert abs((z**2).mean() - 1) < 5 * np.sqrt(2 / z.size)


def test_numbers_are_those_of_numpy_and_scipy(truth):
    draws, energy = truth.draws(3, "independent")
    found = judge(draws, energy, truth.posterior)
    flat = (draws - truth.mean).reshape(-1, MODES)
    moments = flat.T @ flat / TOTAL
    # the two routes to mean and C agree to about 1e-10
    np.testing.assert_allclose(found.variance_ratio, np.diag(moments) / truth.std**2, rtol=1e-8)
    expected = linalg.eigh(moments, truth.covariance, eigvals_only=True)
    np.testing.assert_allclose(found.eigenvalues, expected, rtol=1e-8)
    # effective sizes of independent draws are their number, known to some 10 %: errors to 5 %
    z = flat.mean(0) / (truth.std / np.sqrt(TOTAL))
    np.testing.assert_allclose(found.mean_z, z, rtol=0.15, atol=0)
    np.testing.assert_allclose(found.variance_error, np.sqrt(2 / TOTAL), rtol=0.15)
    values = {check.name: check.value for check in found.checks}
    assert values["mean"] == found.mean_z[np.abs(found.mean_z).argmax()]
    assert values["covariance, smallest"] == found.eigenvalues.min()
    assert values["covariance, largest"] == found.eigenvalues.max()
    assert values["R-hat"] == found.rhat.max() and values["bulk ESS"] == found.ess_bulk.min()
    assert values["tail ESS"] == found.ess_tail.min()
    limits = {check.name: check.upper for check in found.checks}
    # two-sided, shared by all modes
    assert stats.norm.sf(limits["mean"]) * 2 * MODES == pytest.approx(validation.FALSE_ALARM)


# --- wrong posteriors fail --------------------------------------------------------------------


@pytest.mark.parametrize("mode", [0, 7, 15])
@pytest.mark.parametrize("turns", ["independent", "like NUTS"])
def test_a_mean_off_by_a_third_of_sigma_in_one_mode_fails(truth, turns, mode):
    """0.3 sigma is 0.3 sqrt(2000) = 13 errors of the mean, or more; the limit is 4."""
    mean = truth.mean.copy()
    mean[mode] += 0.3 * truth.std[mode]
    found = judge(*truth.draws(1, turns), wrong_posterior(mean, truth.covariance))
    assert "mean" in failed(found)
    assert np.abs(found.mean_z).argmax() == mode
    assert found.mean_z[mode] < -10


DIRECTIONS = [(1.8, "covariance, smallest"), (0.55, "covariance, largest")]


@pytest.mark.parametrize(("factor", "which"), DIRECTIONS)
def test_a_wrong_variance_of_one_direction_fails_though_no_mode_shows_it(factor, which):
    """Sixteen modes with the same share in the direction: each one's variance is off by a
    sixteenth of what the direction's is, 0.05 or 1.6 sigma; the direction's by 0.45 or 0.8,
    where chance allows independent draws 0.82 and 1.19 (Marchenko-Pastur), turning ones somewhat
    more.
    """
    direction = np.where(np.arange(MODES) % 3 == 0, -1.0, 1.0) / np.sqrt(MODES)
    scale = 10.0 ** np.linspace(-2, 2, MODES)
    wrong = np.eye(MODES) + (factor - 1) * np.outer(direction, direction)
    mean = np.linspace(-1, 1, MODES) * scale
    white, energy = chains(2, "independent")
    posterior = wrong_posterior(mean, wrong * np.outer(scale, scale))
    found = judge(mean + white * scale, energy, posterior)
    # the size of that direction also moves the mean eigenvalue by a few percent, which is seen
    assert which in failed(found) and failed(found) <= {which, "covariance, mean"}


@pytest.mark.parametrize("factor", [1.3, 1 / 1.3])
@pytest.mark.parametrize("turns", ["independent", "like NUTS"])
def test_an_overall_variance_off_by_a_third_fails(truth, turns, factor):
    """Errors of a mode's variance: sqrt(2 / 2000) = 3 %, about 6 % for turning chains; of the
    mean over all modes a quarter of that.
    """
    found = judge(*truth.draws(3, turns), wrong_posterior(truth.mean, truth.covariance * factor))
    assert {"variance", "covariance, mean"} <= failed(found) and "mean" not in failed(found)
    assert found.variance_ratio.mean() == pytest.approx(1 / factor, rel=0.05)


def test_an_overall_variance_off_by_a_twentieth_fails_in_the_mean_eigenvalue(truth):
    """No mode and no direction shows 5 %, but the mean over 16 modes of 2000 independent draws
    has an error of sqrt(2 / 32000) = 0.8 %; the margin is six of them.
    """
    wrong = wrong_posterior(truth.mean, truth.covariance / 1.07)
    assert failed(judge(*truth.draws(3, "independent"), wrong)) == {"covariance, mean"}


# --- chains that failed -----------------------------------------------------------------------


def test_one_divergence_is_enough(truth):
    draws, energy = truth.draws(5)
    diverging = np.zeros((CHAINS, DRAWS), bool)
    diverging[2, 17] = True
    assert failed(judge(draws, energy, truth.posterior, diverging)) == {"divergences"}
    assert judge(draws, energy, truth.posterior).passed


def test_a_stuck_chain_fails(truth):
    draws, energy = truth.draws(6)
    draws[1] = draws[1, 0]
    found = judge(draws, energy, truth.posterior)
    assert {"R-hat", "bulk ESS"} <= failed(found) and found.rhat.max() > 1.1


def test_slow_chains_fail_for_their_size_and_not_for_what_they_say(truth):
    """At c = 0.93 means of 4 x 500 draws are worth 70 independent ones, where 400 are asked for."""
    for seed in range(5):
        found = judge(*truth.draws(seed, "slow"), truth.posterior)
        assert {"bulk ESS", "tail ESS"} <= failed(found)
        assert not ({"mean", "covariance, mean"} | COVARIANCE) & failed(found)


def test_badly_explored_energies_fail(truth):
    """A random walk of 500 steps: the steps' variance over the walk's is some 6 / 500."""
    draws, energy = truth.draws(8)
    energy = np.cumsum(np.random.default_rng(8).standard_normal(energy.shape), axis=1)
    assert failed(judge(draws, energy, truth.posterior)) == {"BFMI"}
    # half of a draw's energy is new: steps have the variance of the energies, to some 6 %
    found = judge(*truth.draws(8, "independent"), truth.posterior)
    assert {c.name: c.value for c in found.checks}["BFMI"] == pytest.approx(1.0, abs=0.25)


NOT_COMPARED = [
    (lambda x: x[..., :-1], r"has shape \(4, 500, 15\), expected .* 16\)"),
    (lambda x: x[:, :299], "needs 300 draws of each chain, got 299"),
    (lambda x: np.where(np.arange(MODES) == 3, np.nan, x), "NaN or infinity"),
    (lambda x: np.where(np.arange(MODES) == 3, np.inf, x), "NaN or infinity"),
]


@pytest.mark.parametrize(("broken", "message"), NOT_COMPARED)
def test_draws_that_cannot_be_compared_are_refused(truth, broken, message):
    draws, energy = truth.draws(9)
    draws = broken(draws)
    refuse(message, judge, draws, energy[:, : draws.shape[1]], truth.posterior)
    # three hundred are enough to be judged
    assert judge(*truth.draws(9, draws=300), truth.posterior).eigenvalues.shape == (MODES,)


# --- thresholds -------------------------------------------------------------------------------


def test_a_check_includes_its_limits_and_refuses_nan():
    for value, passed in [(1.0, True), (2.0, True), (0.999, False), (2.001, False)]:
        assert validation.Check("name", value, 1.0, 2.0, "").passed is passed
    assert not validation.Check("name", float("nan"), -np.inf, np.inf, "").passed


def test_scores_of_variances_have_the_tails_of_chi2():
    dof = np.array([50.0, 400.0, 4000.0] * 4)
    upper = np.repeat([True, True, False, False], 3)
    tail = np.repeat([1e-2, 1e-6, 1e-2, 1e-6], 3)
    ratio = np.where(upper, stats.chi2.isf(tail, dof), stats.chi2.ppf(tail, dof)) / dof
    expected = np.where(upper, 1.0, -1.0) * stats.norm.isf(tail)
    np.testing.assert_allclose(validation._chi2_z(ratio, dof), expected, rtol=1e-8)
    # a normal score of the ratio would be off by more than one at 50 degrees of freedom
    assert np.abs((ratio - 1) / np.sqrt(2 / dof) - expected)[[3, 9]].min() > 0.5


def test_eigenvalues_of_independent_draws_lie_between_the_marchenko_pastur_edges():
    """Johnstone (2001): extremes lie near (sqrt(n) +- sqrt(p))^2 / n, by -1.2 and 1.2 Tracy-Widom
    widths inside, with a scatter of 1.3 of them; the mean of 12 runs to 0.4. Draws whose random
    cosines scatter by 1 / sqrt(p) as those of independent ones do are as good as independent.
    """
    p, n = 60, CHAINS * 400
    white = np.random.default_rng(1).standard_normal((CHAINS, 400, p))
    null = validation._null_eigenvalues(white, np.random.default_rng(2))
    assert null.shape == (validation.NULL_RUNS, p)
    assert (np.diff(null, axis=1) >= 0).all()
    for end, sign in [(-1, 1.0), (0, -1.0)]:
        edge = np.sqrt(n) + sign * np.sqrt(p)
        width = abs(edge) * abs(1 / np.sqrt(n) + sign / np.sqrt(p)) ** (1 / 3) / n
        # 5 x 0.4 widths; about 1 % of the eigenvalue
        assert abs(null[:, end].mean() - (edge**2 / n - sign * 1.2065 * width)) < 2.0 * width
        assert 0.4 * width < null[:, end].std(ddof=1) < 3.0 * width
    # the mean eigenvalue is the trace: chi^2 of all numbers
    assert abs(null.mean() - 1) < 5 * np.sqrt(2 / (validation.NULL_RUNS * n * p))


def test_draws_that_turn_round_count_once_in_the_covariance():
    """x, -x, x, ...: four chains hold four directions, though their means are exact."""
    start = np.random.default_rng(3).standard_normal((CHAINS, 1, 10))
    white = start * np.where(np.arange(100) % 2, -1.0, 1.0)[None, :, None]
    null = validation._null_eigenvalues(white, np.random.default_rng(4))
    assert np.abs(null[:, : 10 - CHAINS]).max() < 1e-12 and null[:, 10 - CHAINS :].min() > 1e-3
    # repeated draws, whose sine rounding must not make NaN, do the same
    repeated = validation._null_eigenvalues(np.repeat(start, 100, 1), np.random.default_rng(4))
    np.testing.assert_allclose(repeated, null, rtol=0, atol=1e-12)


@pytest.mark.parametrize("c", [0.9, -0.9, 0.5])
def test_simulated_chains_turn_as_far_as_the_real_ones(c):
    """The variance of the mean eigenvalue is 2 / (draws x modes) times (1 + c^2) / (1 - c^2).

    From 240 runs: its root to 1 / sqrt(480) = 4.6 %. Forgetting the turns would give a third of it
    at |c| = 0.9, taking c for c^2 4.4 instead of 3.1.
    """
    rng = np.random.default_rng(5)
    p, draws = 4, 200
    white = np.empty((CHAINS, draws, p))
    white[:, 0] = rng.standard_normal((CHAINS, p))
    for t in range(1, draws):
        unit = white[:, t - 1] / np.linalg.norm(white[:, t - 1], axis=1, keepdims=True)
        side = rng.standard_normal((CHAINS, p))
        side -= (side * unit).sum(1, keepdims=True) * unit
        side /= np.linalg.norm(side, axis=1, keepdims=True)
        # of any lengths: only the angle counts
        white[:, t] = (c * unit + np.sqrt(1 - c**2) * side) * rng.uniform(0.5, 2, (CHAINS, 1))
    means = [validation._null_eigenvalues(white, rng).mean(1) for _ in range(20)]
    expected = np.sqrt(2 / (CHAINS * draws * p) * (1 + c**2) / (1 - c**2))
    assert np.std(means) == pytest.approx(expected, rel=0.2)
    assert np.mean(means) == pytest.approx(1.0, abs=5 * expected / np.sqrt(240))


def test_normal_scores_of_variances_far_out():
    """Where chi^2 has no tail any more: the root of its deviance, to a sixth of it."""
    ratio, dof = np.array([0.01, 0.05, 5.0, 50.0]), 500.0
    deviance = np.sqrt(dof * (ratio - 1.0 - np.log(ratio)))
    far = validation._chi2_z(ratio, np.full(4, dof))
    np.testing.assert_allclose(far, np.sign(ratio - 1.0) * deviance, rtol=1 / 6)
