"""HMC and simulated data sets against the analytic posterior: the checks and their verdict."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lusee_bayes.results.sample_result import SampleResult
from lusee_bayes.results.summaries import ValidationSummary
from lusee_bayes.sampling.validation import Check, Comparison, Ranks

# what a comparison has mode by mode
OF_MODES = (
    *("mean_z", "variance_ratio", "variance_error", "eigenvalues", "null_eigenvalues"),
    *("ess_bulk", "ess_tail"),
)


@dataclass(frozen=True)
class ValidationResult:
    """A sampled run judged against the analytic posterior.

    Attributes
    ----------
    name : str
        Of the scenario.
    sampled : SampleResult
    comparison : Comparison
        Draws against mean, variances and covariance.
    ranks : Ranks
        Simulation-based calibration.
    """

    name: str
    sampled: SampleResult
    comparison: Comparison
    ranks: Ranks

    @property
    def checks(self) -> list[Check]:
        """All of them, calibration last."""
        return [*self.comparison.checks, calibration_check(self.ranks)]

    @property
    def passed(self) -> bool:
        """Whether every check passed."""
        return all(check.passed for check in self.checks)

    def headline(self) -> str:
        """The verdict, in one line."""
        checks = self.checks
        verdict = "passed" if self.passed else "FAILED"
        return f"{verdict}: {sum(c.passed for c in checks)} of {len(checks)} checks hold"

    def summary(self) -> ValidationSummary:
        """validation.json."""
        ranks = self.ranks
        levels = ranks.coverage().items()
        return ValidationSummary(
            passed=self.passed,
            checks=self.checks,
            modes={name: getattr(self.comparison, name).tolist() for name in OF_MODES},
            coverage={name: {f"{p:g}": x for p, x in shares.items()} for name, shares in levels},
            p_values=dict(zip(ranks.names, ranks.p_values().tolist(), strict=True)),
        )


def calibration_check(ranks: Ranks) -> Check:
    """The verdict of calibration as one check."""
    n, least = len(ranks.names), float(ranks.p_values().min())
    meaning = f"smallest p-value of {n} rank histograms over {ranks.n_simulations} simulations"
    return Check("calibration", least, ranks.threshold, 1.0, meaning)


def allowed(check: Check) -> str:
    """The interval of a check in words."""
    if check.lower == check.upper:
        return f"{check.upper:g}"
    if not np.isfinite(check.upper):
        return f"at least {check.lower:.4g}"
    if check.lower == -check.upper:
        return f"+- {check.upper:.4g}"
    return f"{check.lower:.4g} to {check.upper:.4g}"
