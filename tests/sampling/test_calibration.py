"""Simulation-based calibration: passes for right posteriors, and notices wrong ones.

By the analytic posterior, with every kind of N. The data are so few (96 of 49 modes) that between
1 % and 80 % of the modes' variances is left from the prior.
"""

from contextlib import contextmanager
from functools import lru_cache

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from assertions import refuse
from jaxtyping import Array, Float
from scipy import stats
from small_models import NOISES, noisy

import lusee_bayes as lb
from lusee_bayes.core.progress import Stages
from lusee_bayes.experiment.model import full_model, set_up
from lusee_bayes.judge.coverage import LEVELS
from lusee_bayes.sampling import validation

# one of them every time, the others by make long
EVERY_NOISE = pytest.mark.parametrize(
    "noise", [n if n == "exact" else pytest.param(n, marks=pytest.mark.long) for n in NOISES]
)


@lru_cache
def model(noise: str) -> lb.LinearGaussian:
    return full_model(set_up(noisy(noise)))


def p_values(ranks: validation.Ranks) -> dict[str, float]:
    return dict(zip(ranks.names, ranks.p_values().tolist(), strict=True))


def assert_calibrated(ranks: validation.Ranks) -> None:
    """Even ranks, and coverages within four errors."""
    assert ranks.passed, p_values(ranks)
    for name, coverage in ranks.coverage().items():
        for level, share in coverage.items():
            assert abs(share - level) < 4 * ranks.coverage_error(level), (name, level)


# --- ranks ------------------------------------------------------------------------------------


def ranks_of(*columns, regions=()) -> validation.Ranks:
    return validation.Ranks(np.stack(columns, axis=1), tuple("abcdefgh"[: len(columns)]), regions)


def test_the_histogram_has_twenty_bins_of_five_ranks():
    column = np.repeat([0, 4, 5, 49, 50, 94, 95, 99], [1, 2, 4, 8, 16, 32, 64, 128])
    expected = np.zeros(20, int)
    expected[[0, 1, 9, 10, 18, 19]] = [3, 4, 8, 16, 32, 192]
    ranks = ranks_of(column, column[::-1])
    np.testing.assert_array_equal(ranks.histogram(), [expected, expected])
    assert ranks.n_simulations == 255


def test_coverage_counts_from_the_middle_or_from_the_inside():
    """A truth below all draws of its distance is the likeliest, of a mode the least likely."""
    for rank, interval, region in [
        (0, [], LEVELS),
        (49, LEVELS, LEVELS),
        (50, LEVELS, (0.68, 0.90, 0.95)),
        (76, (0.68, 0.90, 0.95), (0.90, 0.95)),
        (16, (0.68, 0.90, 0.95), LEVELS),
        (93, (0.90, 0.95), (0.95,)),
        (5, (0.90, 0.95), LEVELS),
        (99, [], []),
    ]:
        column = np.full(7, rank)
        coverage = ranks_of(column, column, regions=("b",)).coverage()
        assert coverage["a"] == {p: float(p in interval) for p in LEVELS}, rank
        assert coverage["b"] == {p: float(p in region) for p in LEVELS}, rank


@pytest.mark.parametrize(("n", "probability"), [(500, 0.99), (100, 0.99), (500, 0.5)])
def test_the_band_holds_a_bin_with_its_probability(n, probability):
    counts = np.arange(n + 1)
    pmf = stats.binom.pmf(counts, n, 1 / 20)
    low, high = ranks_of(np.zeros(n, int)).band(probability)
    tail = (1 - probability) / 2
    assert pmf[counts < low].sum() <= tail < pmf[counts <= low].sum()
    assert pmf[counts > high].sum() <= tail < pmf[counts >= high].sum()


def test_p_values_are_those_of_chi2_of_the_histogram():
    rng = np.random.default_rng(1)
    ranks = ranks_of(*[rng.integers(0, 100, 500), rng.binomial(99, 0.5, 500), np.arange(500) % 100])
    chi2 = ((ranks.histogram() - 25.0) ** 2 / 25.0).sum(1)
    np.testing.assert_allclose(ranks.p_values(), stats.chi2.sf(chi2, 19), rtol=1e-10)
    assert ranks.p_values()[1] < 1e-100 and ranks.p_values()[2] == 1.0


def test_the_threshold_is_shared_by_all_quantities():
    even = np.arange(500) % 100
    uneven = even.copy()
    # moved from other bins to the first: chi^2 = (24 (24/19) + 24^2) / 25 = 24.3
    one, eight = ranks_of(even), ranks_of(*[even] * 8)
    assert one.threshold == pytest.approx(validation.FALSE_ALARM)
    assert eight.threshold == pytest.approx(validation.FALSE_ALARM / 8)
    p, moved = 1.0, 0
    while p > validation.FALSE_ALARM:
        uneven[(5 + 5 * (moved % 19) + 100 * (moved // 19))] = 0
        moved += 1
        p = ranks_of(uneven).p_values()[0]
    assert validation.FALSE_ALARM / 8 < p < validation.FALSE_ALARM
    assert not ranks_of(uneven).passed
    # the same among eight quantities is not that rare
    assert ranks_of(uneven, *[even] * 7).passed
    assert one.passed and eight.passed
    assert not ranks_of(np.full(500, 7), *[even] * 7).passed


# --- calibrate, where the answer is known in closed form --------------------------------------


class Counting(Stages):
    """Keeps what is told of progress."""

    def __init__(self):
        super().__init__()
        self.done = []

    @contextmanager
    def progress(self, name, total):
        yield lambda done, remark="": self.done.append(done)


def test_ranks_count_the_draws_below_the_truth():
    def simulate(key):
        x = jnp.asarray([37.5, 0.5, validation.N_DRAWS + 0.5])
        return {"x": x, "y": jnp.asarray(98.0)}, jnp.zeros(1)

    def draw(key, data):
        grid = jnp.arange(1.0, validation.N_DRAWS + 1.0)
        shuffled = jax.random.permutation(key, grid)
        return {"x": jnp.stack([shuffled, grid, grid], axis=1), "y": shuffled}

    stages = Counting()
    options = {"n_simulations": 130, "batch": 60, "stages": stages}
    ranks = validation.calibrate(simulate, draw, lambda sky, data: sky, **options)
    assert ranks.names == ("x 0", "x 1", "x 2", "y")
    # 37 of 1, 2, ... lie below 37.5; 97 below 98
    np.testing.assert_array_equal(ranks.ranks, np.tile([37, 0, validation.N_DRAWS, 97], (130, 1)))
    assert stages.done == [1, 2, 3]  # batches


class Conjugate(eqx.Module):
    """m ~ N(0, 1), d = m + S n: the posterior is N(d / (1 + s^2), s^2 / (1 + s^2)) with s = S.

    Its mean is off by ``shift`` standard deviations and its random term by ``scale``.
    """

    shift: Float[Array, ""]
    scale: Float[Array, ""]
    s: Float[Array, ""]

    def simulate(self, key):
        truth, noise = jax.random.normal(key, (2,), dtype=jnp.float64)
        return truth, (truth + S * noise)[None]

    def draw(self, key, data):
        z = jax.random.normal(key, (validation.N_DRAWS,), dtype=jnp.float64)
        std = self.s / jnp.sqrt(1 + self.s**2)
        return data[0] / (1 + self.s**2) + std * (self.shift + self.scale * z)

    def quantities(self, m, data):
        distance = (m - data[0] / (1 + S**2)) ** 2
        return {"m": m, "distance": distance, "log likelihood": -((data[0] - m) ** 2)}


S = 0.7


def conjugate(shift=0.0, scale=1.0, s=S, simulations=500, **options) -> validation.Ranks:
    model = Conjugate(*(jnp.asarray(float(x)) for x in (shift, scale, s)))
    given = model.simulate, model.draw, model.quantities
    options |= {"n_simulations": simulations, "regions": ("distance",)}
    return validation.calibrate(*given, **options)


def test_the_conjugate_posterior_is_calibrated():
    ranks = conjugate()
    assert ranks.ranks.shape == (500, 3)
    assert ranks.ranks.min() == 0 and ranks.ranks.max() == validation.N_DRAWS
    # 12 numbers: beyond 4 errors once in a thousand tests
    assert_calibrated(ranks)


@pytest.mark.long
def test_every_data_set_is_another_and_batches_do_not_matter():
    few, many = (conjugate(simulations=120, batch=b) for b in (25, 120))
    np.testing.assert_array_equal(few.ranks, many.ranks)
    assert (conjugate(simulations=120, seed=1).ranks != few.ranks).mean() > 0.9
    # an empty bin or a bin of 20 of 120 ranks: once in a million
    assert few.histogram()[0].max() < 20
    # truths and their ranks are not drawn with the same numbers
    assert abs(np.corrcoef(few.ranks[1:, 0], few.ranks[:-1, 0])[0, 1]) < 5 / np.sqrt(120)


WRONG_POSTERIORS = [
    # ranks of m pile up at one end, or at both, or in the middle
    ({"shift": 0.5}, "m"),
    ({"scale": np.sqrt(2)}, "distance"),
    pytest.param({"scale": np.sqrt(0.5)}, "distance", marks=pytest.mark.long),
    # the noise taken for half of its variance: the data pull too much
    pytest.param({"s": S / np.sqrt(2)}, "m", marks=pytest.mark.long),
]


@pytest.mark.parametrize(("wrong", "caught"), WRONG_POSTERIORS)
def test_a_wrong_conjugate_posterior_is_noticed(wrong, caught):
    ranks = conjugate(**wrong)
    assert not ranks.passed and p_values(ranks)[caught] < 1e-6


def test_a_posterior_that_ignores_the_data_is_noticed_only_by_what_depends_on_them():
    """Modrak et al. (2023): the prior is calibrated for every function of m alone."""

    # taken for infinitely noisy, data leave the posterior at the prior
    p = p_values(conjugate(s=1e10))
    assert p["m"] > validation.FALSE_ALARM and p["log likelihood"] < 1e-20


def test_too_few_data_sets_are_refused():
    refuse("100 simulations.*99", conjugate, simulations=99)
    assert conjugate(simulations=100).n_simulations == 100
    refuse("got 20", validation.calibrate_sky, *[random_model(True)] * 2, n_simulations=20)


# --- calibrate_sky ----------------------------------------------------------------------------


@pytest.mark.long
@EVERY_NOISE
def test_the_sky_is_calibrated(noise):
    ranks = validation.calibrate_sky(model(noise), model(noise), seed=1)
    assert ranks.n_simulations == 500
    assert len(ranks.names) == len(set(ranks.names)) == 22
    assert {"mode 0", "mode 48", "projection 9", "distance", "log likelihood"} < set(ranks.names)
    # 88 numbers, many of them tied to each other: beyond 4 errors once in 200 tests
    assert_calibrated(ranks)


def random_model(offset: bool) -> lb.LinearGaussian:
    rng = np.random.default_rng(1)
    return lb.LinearGaussian(
        jnp.asarray(rng.standard_normal((6, 9))),
        lb.HarmonicPrior(jnp.asarray([4.0, 1.0, 0.5])),
        lb.DiagonalCovariance(jnp.asarray(rng.uniform(0.2, 1.0, 6))),
        jnp.asarray(5.0 * rng.standard_normal(6) * offset),
    )


def test_what_is_ranked_of_a_sky():
    """Against the textbook's formulas with matrices, with fewer data than modes and an offset."""
    gaussian = random_model(True)
    directions = np.random.default_rng(0).standard_normal((3, 9))
    sky, data = (np.asarray(x) for x in gaussian.sample(jax.random.key(3)))
    arrays = (jnp.asarray(x) for x in (np.array([0, 2, 5, 8]), directions, sky, data))
    got = validation.ranked_of_sky(gaussian.factorise(), *arrays)
    np.testing.assert_array_equal(got["mode"], sky[[0, 2, 5, 8]])
    s, n = np.asarray(gaussian.prior.variance()), np.asarray(gaussian.noise.dense())
    np.testing.assert_allclose(got["projection"], directions @ (sky / np.sqrt(s)), rtol=1e-12)
    a, offset = np.asarray(gaussian.coupling.dense()), np.asarray(gaussian.offset)
    precision = a.T @ np.linalg.solve(n, a) + np.diag(1 / s)
    off = sky - np.linalg.solve(precision, a.T @ np.linalg.solve(n, data - offset))
    assert float(got["distance"]) == pytest.approx(off @ precision @ off, rel=1e-10)
    residual = data - offset - a @ sky
    expected = -residual @ np.linalg.solve(n, residual) / 2
    assert float(got["log likelihood"]) == pytest.approx(expected, rel=1e-10)


@pytest.mark.long
def test_fewer_data_than_modes_with_an_offset():
    ranks = validation.calibrate_sky(random_model(True), random_model(True))
    assert ranks.passed, p_values(ranks)
    assert {f"mode {i}" for i in range(9)} < set(ranks.names)
    assert not validation.calibrate_sky(random_model(True), random_model(False)).passed


@pytest.mark.long
@pytest.mark.parametrize("factor", [2.0, 0.5])
@EVERY_NOISE
def test_a_noise_off_by_sqrt_2_is_noticed(noise, factor):
    truth = model(noise)
    wrong = lb.LinearGaussian(truth.coupling, truth.prior, truth.noise.scaled(factor))
    ranks = validation.calibrate_sky(truth, wrong, seed=1)
    assert not ranks.passed
    p = p_values(ranks)
    assert max(p["distance"], p["log likelihood"]) < 1e-8


# --- by Hamiltonian Monte Carlo ---------------------------------------------------------------
