"""Verdicts of three levels: probabilities uniform where the model holds, and thresholds."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from lusee_bayes.linear.fit import LEVELS, MISFIT, TENSION, level_of, two_sided, worst


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


def test_levels_at_their_thresholds():
    below = 1.0 - 1e-9
    assert level_of(TENSION) == "consistent"
    assert level_of(TENSION * below) == level_of(MISFIT) == "in tension"
    assert level_of(MISFIT * below) == level_of(0.0) == "does not fit"
    # the best of many is nothing special
    assert level_of(1e-3, 10) == "consistent"
    assert level_of(1e-3, 9) == "in tension"
    assert worst(["in tension", "consistent"]) == "in tension"
    assert worst(list(LEVELS)) == "does not fit"


def test_the_least_of_many_is_called_tense_once_in_a_hundred():
    """Bonferroni: at most TENSION, and for independent groups nearly that."""
    p = np.random.default_rng(2).uniform(size=(40_000, 45)).min(axis=1)
    tense = np.mean([level_of(float(x), 45) != "consistent" for x in p])
    exact = 1.0 - (1.0 - TENSION / 45) ** 45
    assert tense == pytest.approx(exact, abs=4 * np.sqrt(exact / len(p)))
