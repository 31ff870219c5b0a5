"""Coverage and its scatter: by counting with loops, and against simulated skies."""

from __future__ import annotations

from statistics import NormalDist

import healpy
import numpy as np
import pytest
from scipy.stats import kstest

from lusee_bayes.core.harmonics import modes_to_map, pixel_matrix
from lusee_bayes.linear.levels import LEVELS
from lusee_bayes.results.coverage import N_DRAWS, Counts, Coverage, p_of_largest, p_of_shares

NSIDE, LMAX = 8, 6
N_MODES = (LMAX + 1) ** 2
# half-widths of central intervals, in standard deviations
LIMITS = [NormalDist().inv_cdf(0.5 + level / 2) for level in LEVELS]


def by_hand(pulls):
    """Shares within the intervals, rms and largest, one after the other."""
    shares = [sum(abs(z) < limit for z in pulls) / len(pulls) for limit in LIMITS]
    return [*shares, (sum(z * z for z in pulls) / len(pulls)) ** 0.5, max(map(abs, pulls))]


def compare(found: Coverage, truth, draws):
    """One part against counts by hand of the truth and of every draw."""
    expected, drawn = by_hand(truth), np.array([by_hand(draw) for draw in draws])
    assert found.n == len(truth)
    np.testing.assert_allclose([*found.held, found.rms, found.largest], expected, rtol=1e-12)
    scatter = drawn.std(0)
    np.testing.assert_allclose([*found.scatter, found.rms_scatter], scatter[:5], rtol=1e-9)
    assert found.allowed == pytest.approx(np.quantile(drawn[:, 5], 0.95))


def test_pixels_are_counted_by_latitude():
    rng = np.random.default_rng(1)
    std = rng.uniform(0.5, 2.0, 12 * NSIDE**2)
    error, draws = rng.standard_normal(N_MODES), rng.standard_normal((7, N_MODES))
    pull, *drawn = [modes_to_map(sky, NSIDE) / std for sky in (error, *draws)]
    b = np.degrees(np.pi / 2 - healpy.pix2ang(NSIDE, np.arange(len(std)))[0])
    found = Counts.of_pixels(std, error, draws).coverage()
    assert [part.name for part in found] == [
        "|b| < 10 deg",
        "|b| 10 to 30 deg",
        "|b| > 30 deg",
        "whole sky",
    ]
    bands = [(0, 10), (10, 30), (30, 90), (0, 90)]
    for part, (low, high) in zip(found, bands, strict=True):
        here = [k for k in range(len(b)) if low <= abs(b[k]) < high]
        compare(part, pull[here], [draw[here] for draw in drawn])
        assert Coverage.from_row(part.row()) == part


def test_modes_are_counted_by_multipole():
    rng = np.random.default_rng(2)
    std, error, draws = rng.uniform(0.5, 2.0, N_MODES), *np.split(rng.standard_normal((8, 49)), [1])
    # what is known exactly is where it should be, in every draw too
    std[30] = error[0, 30] = 0.0
    draws[:, 30] = 0.0
    mean, low, high, every = Counts.of_modes(std, error[0], draws).coverage()
    names = [part.name for part in (mean, low, high, every)]
    assert names == ["ell 0", "ell 1 to 4", "ell 5 to 6", "every ell"]
    width = np.where(std > 0, std, 1.0)
    compare(low, error[0, 1:25] / width[1:25], draws[:, 1:25] / width[1:25])
    compare(high, error[0, 25:] / width[25:], draws[:, 25:] / width[25:])
    compare(every, error[0] / width, draws / width)


@pytest.fixture(scope="module")
def ensemble():
    """Coverage of 200 skies drawn from a prior, each seen through the same noisy instrument, and
    the counts of one of them: textbook formulas."""
    rng = np.random.default_rng(3)
    ell = np.repeat(np.arange(LMAX + 1), 2 * np.arange(LMAX + 1) + 1)
    prior = 3.0 / (1.0 + ell)
    # data that know the north better than the south, and large scales better than small ones
    y = pixel_matrix(4, LMAX)
    north = np.arange(len(y)) < len(y) // 3
    a = y[north] / 0.2
    covariance = np.linalg.inv(a.T @ a + np.diag(prior**-2.0))
    root = np.linalg.cholesky(covariance)
    on_map = pixel_matrix(NSIDE, LMAX)
    std = np.sqrt(((on_map @ root) ** 2).sum(1))

    def counts(scale=1.0):
        """A posterior whose standard deviations are off by a factor."""
        sky = prior * rng.standard_normal(N_MODES)
        mean = covariance @ (a.T @ (a @ sky + rng.standard_normal(len(a))))
        drawn = rng.standard_normal((N_DRAWS, N_MODES)) @ root.T
        return Counts.of_pixels(scale * std, sky - mean, scale * drawn)

    return counts, [counts().coverage() for _ in range(200)]


def test_the_scatter_is_that_of_simulated_skies(ensemble):
    """Of 200 skies and 300 draws the ratio is known to 7 %; independent pixels would scatter a
    third as much. The means of shares are the levels."""
    _, found = ensemble
    for k in range(4):
        for name in ("held", "rms"):
            values = np.array([getattr(bands[k], name) for bands in found])
            scatter = "scatter" if name == "held" else "rms_scatter"
            told = np.median([getattr(bands[k], scatter) for bands in found], axis=0)
            np.testing.assert_allclose(values.std(0) / told, 1.0, atol=0.28)
            if name == "held":
                off = (values.mean(0) - LEVELS) / (values.std(0) / np.sqrt(len(values)))
                assert np.abs(off).max() < 4.0
        pixels = found[0][k].n
        independent = np.sqrt(0.68 * 0.32 / pixels)
        assert found[0][k].scatter[1] > 2.0 * independent
        above = np.mean([bands[k].largest > bands[k].allowed for bands in found])
        # 5 % +- 1.5 % of 200 skies, and as much for the quantile of 300 draws
        assert above == pytest.approx(0.05, abs=0.06)


def p_values(counts, n):
    """The two tests of as many skies."""
    found = [counts() for _ in range(n)]
    return np.array([[p_of_shares(one), p_of_largest(one)] for one in found])


# the seed is fixed: an error bar that is right fails once in 10,000 seeds
RARE = 1e-4


def test_p_values_are_uniform_where_error_bars_are_right(ensemble):
    for column in p_values(ensemble[0], 120).T:
        assert kstest(column, "uniform").pvalue > RARE


@pytest.mark.parametrize("factor", [1.3, 1 / 1.3])
def test_error_bars_that_are_too_wide_or_narrow_are_found(factor, ensemble):
    shares = p_values(lambda: ensemble[0](factor), 40)[:, 0]
    assert kstest(shares, "uniform").pvalue < RARE
