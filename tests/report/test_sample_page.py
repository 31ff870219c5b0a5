"""What the page of a sampled run warns of, and why; ticks that fit their panels."""

from __future__ import annotations

import numpy as np
import pytest

from lusee_bayes.report.figures.drawing import number_of_tick
from lusee_bayes.results.draws import warnings_of

GOOD = {"r_hat": [1.0, 1.005], "ess_bulk": [900.0, 800.0], "ess_tail": [700.0, 600.0]}
SAMPLED = {"chains": 4, "draws": 500, "divergences": 0}


def warned(sampling=None, **columns):
    table = {name: np.array(values) for name, values in (GOOD | columns).items()}
    names = np.array(["T(centre) [K]", "C_5 [K2]"])
    return warnings_of({"quantity": names, **table}, SAMPLED | (sampling or {}))


def test_good_draws_are_not_warned_of():
    assert warned() == []
    # what too few draws cannot tell is no reason
    assert warned(r_hat=[np.nan, np.nan]) == []


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"r_hat": [1.002, 1.09]}, ("Not converged", "(1.090)")),
        ({"r_hat": [np.inf, 1.0]}, ("Not converged", "(inf)")),
        ({"r_hat": [1.002, 1.03]}, ("R-hat", "1 of 2", "C_5 [K2] (1.030)", "--draws")),
        ({"ess_bulk": [399.0, 900.0]}, ("bulk", "below 400", "T(centre) [K] (399)")),
        ({"ess_tail": [399.0, 12.0]}, ("tail", "2 of 2", "C_5 [K2] (12)")),
        ({"sampling": {"divergences": 3}}, ("3 trajectories diverged", "--warmup")),
    ],
)
def test_every_warning_has_its_reason(change, words):
    (found,) = warned(**change)
    assert all(word in found for word in words)


@pytest.mark.parametrize(
    ("value", "text"),
    [(0.0, "0"), (12500.0, "12,500"), (0.25, "0.25"), (1.5e10, "1.5e10"), (-2e-5, "-2e-5")],
)
def test_ticks_are_short(value, text):
    assert number_of_tick(value) == text
    assert float(text.replace(",", "")) == value
