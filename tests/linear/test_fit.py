"""Probabilities are uniform where the model holds; one rate of false alarms for all."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from lusee_bayes.linear.fit import FALSE_ALARM, LEVELS, ChiSquare, stands_out, two_sided, worst


@pytest.mark.parametrize("n", [1, 40, 5232])
def test_probabilities_are_uniform_if_the_model_holds(n):
    drawn = np.random.default_rng(1).chisquare(n, 20_000)
    p = [two_sided(float(x), n) for x in drawn]
    # a hundred such tests in a thousand runs of the suite would fail at 1e-4; the seed is fixed
    assert stats.kstest(p, "uniform").pvalue > 1e-4


def test_both_sides_count():
    for q in (1e-8, 1e-3, 0.2):
        for chi2 in (stats.chi2.isf(q, 100), stats.chi2.ppf(q, 100)):
            assert two_sided(float(chi2), 100) == pytest.approx(2 * q, rel=1e-9)
    assert two_sided(0.0, 100) == 0.0
    assert 0.999 < two_sided(float(stats.chi2.median(100)), 100) <= 1.0


def test_one_rate_for_all_tests_of_a_report():
    below = 1.0 - 1e-9
    assert not stands_out(FALSE_ALARM, 1) and stands_out(FALSE_ALARM * below, 1)
    # the best of many is nothing special
    assert not stands_out(1e-4, 10) and stands_out(1e-4, 9)
    assert worst(["unlike the prior", "consistent"]) == "unlike the prior"
    assert worst(list(LEVELS)) == "does not fit"


def test_the_least_of_many_stands_out_once_in_a_thousand():
    """Bonferroni: at most FALSE_ALARM, and for independent groups nearly that."""
    p = np.random.default_rng(2).uniform(size=(100_000, 45)).min(axis=1)
    found = np.mean([stands_out(float(x), 45) for x in p])
    exact = 1.0 - (1.0 - FALSE_ALARM / 45) ** 45
    assert found == pytest.approx(exact, abs=4 * np.sqrt(exact / len(p)))


def test_what_was_found_is_told_with_what_was_expected():
    part = ChiSquare(130.0, 98.0)
    assert part.p == pytest.approx(2 * stats.chi2.sf(130.0, 98.0))
    assert part.words() == f"p = {part.p:.2g}, chi^2 130, expected 98 +- 14"
    assert ChiSquare(1e9, 98.0).words().startswith("p < 1e-300, chi^2 1000000000")
