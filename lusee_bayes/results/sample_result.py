"""A sampled scenario: its draws, statistics of the sky, and their validation.

A validation compares HMC and simulated data sets with the analytic posterior. It has checks, and a
verdict.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import pandas as pd
import xarray as xr

from lusee_bayes.core import arrays, progress
from lusee_bayes.experiment.experiment import Experiment
from lusee_bayes.experiment.rounds import Inference
from lusee_bayes.judge.convergence import warnings_of
from lusee_bayes.results.summaries import SamplingSummary, ValidationSummary
from lusee_bayes.sampling import mode
from lusee_bayes.sampling.validation import Check, Comparison, Ranks
from lusee_bayes.sky.galaxy import LANDMARKS
from lusee_bayes.systematics.systematic import SKY

SAMPLES, CHAINS = "samples.nc", "chains"
# longest site whose elements are quantities, too
LISTED = 20


@dataclass(frozen=True)
class SampleResult:
    """Draws of a program given an experiment's data, together with the analytic posterior.

    Attributes
    ----------
    experiment : Experiment
    inference : Inference
        The linear model with every systematic in N, and its posterior.
    tree : xarray.DataTree
        The draws, in ArviZ's groups.
    seconds : dict
        By stage.
    steps_per_second : float or None
        All chains together while drawing; None if this session drew too little to measure it.
    """

    experiment: Experiment
    inference: Inference
    tree: xr.DataTree
    seconds: dict[str, float]
    steps_per_second: float | None

    @property
    def skies(self) -> np.ndarray:
        """Draws of the sky, (chains, draws, modes), in K."""
        return self.tree["posterior"][SKY].values

    def quantities(self) -> dict[str, np.ndarray]:
        """Draws (chains, draws) of sites with few elements, landmarks, powers and lowest modes."""
        lmax = self.experiment.scenario.lmax
        sites = self.tree["posterior"].data_vars.items()
        others = {name: x.values for name, x in sites if name != SKY and x.ndim == 2}
        for name, x in sites:
            if name != SKY and x.ndim == 3 and x.shape[2] <= LISTED:
                others |= {f"{name}[{k}]": x.values[..., k] for k in range(x.shape[2])}
        ells = sorted({min(ell, lmax) for ell in (0, 1, 2, 5, 10, 20, 30, 40)})
        modes = [(ell, m) for ell in range(min(lmax, 2) + 1) for m in range(-ell, ell + 1)]
        return others | mode.sky_quantities(self.skies, pixels=LANDMARKS, ells=ells, modes=modes)

    @cached_property
    def summary(self) -> pd.DataFrame:
        """ArviZ's summary of :meth:`quantities`."""
        return mode.summary(self.quantities())

    @cached_property
    def maps(self) -> dict[str, np.ndarray]:
        """Mean, standard deviation and 90 % interval of every pixel, in K."""
        return mode.pixel_statistics(self.skies, self.experiment.scenario.map_nside)

    @cached_property
    def highest_altitude(self) -> arrays.Pixels:
        """sin of the highest altitude of every pixel."""
        return self.experiment.highest_altitude

    def headline(self) -> str:
        """The main figures, in one line."""
        table, figures = self.summary, self.figures()
        parts = [
            f"{figures.chains} x {figures.draws} draws of {figures.program}",
            f"R-hat at most {table['r_hat'].max():.4f}",
            f"bulk ESS at least {table['ess_bulk'].min():.0f}",
            f"{figures.divergences} divergences",
        ]
        if self.steps_per_second is not None:
            parts.append(f"{self.steps_per_second:.0f} steps/s")
        return ", ".join(parts)

    def lines(self) -> list[str]:
        """Lines for a terminal."""
        table, figures = self.summary.rename_axis("quantity").reset_index(), self.figures()
        columns = {name: table[name].to_numpy() for name in table}
        reasons = warnings_of(columns, **figures.model_dump(include={"chains", "divergences"}))
        return [self.headline(), *reasons, *self.experiment.doubts]

    def figures(self) -> SamplingSummary:
        """Contents of sampling.json: sizes, speeds, times, memory, versions."""
        stats = self.tree["sample_stats"]
        chains, draws = self.skies.shape[:2]
        return SamplingSummary(
            program=self.tree.attrs["program"],
            chains=chains,
            draws=draws,
            divergences=int(stats["diverging"].sum()),
            mean_acceptance=float(stats["acceptance_rate"].mean()),
            doubts=list(self.experiment.doubts),
            step_size=[float(x) for x in stats["step_size"].values[:, -1]],
            mean_steps=float(stats["n_steps"].mean()),
            steps_per_second=self.steps_per_second,
            **progress.about_run(self.seconds),
        )


# statistics that a comparison has for each mode
OF_MODES = ("mean_z", "variance_ratio", "variance_error", "eigenvalues", "null_eigenvalues")
OF_MODES += ("ess_bulk", "ess_tail")


@dataclass(frozen=True)
class ValidationResult:
    """A sampled run compared with the analytic posterior.

    Attributes
    ----------
    name : str
        Name of the scenario.
    sampled : SampleResult
    comparison : Comparison
        Draws compared with mean, variances and covariance.
    ranks : Ranks
        Simulation-based calibration.
    """

    name: str
    sampled: SampleResult
    comparison: Comparison
    ranks: Ranks

    @property
    def checks(self) -> list[Check]:
        """All checks, calibration last."""
        n, least = len(self.ranks.names), float(self.ranks.p_values().min())
        n_simulations, limit = self.ranks.n_simulations, self.ranks.threshold
        meaning = f"smallest p-value of {n} rank histograms over {n_simulations} simulations"
        return [*self.comparison.checks, Check("calibration", least, limit, 1.0, meaning)]

    @property
    def passed(self) -> bool:
        """Whether every check passed."""
        return all(check.passed for check in self.checks)

    def headline(self) -> str:
        """The verdict, in one line."""
        checks, verdict = self.checks, "passed" if self.passed else "FAILED"
        return f"{verdict}: {sum(c.passed for c in checks)} of {len(checks)} checks pass"

    def summary(self) -> ValidationSummary:
        """Contents of validation.json."""
        ranks = self.ranks
        return ValidationSummary(
            passed=self.passed,
            checks=self.checks,
            modes={name: getattr(self.comparison, name).tolist() for name in OF_MODES},
            coverage=ranks.coverage(),
            p_values=dict(zip(ranks.names, ranks.p_values().tolist(), strict=True)),
        )

    @staticmethod
    def allowed(check: Check) -> str:
        """The interval that a check allows, in words."""
        if check.lower == check.upper:
            return f"{check.upper:g}"
        if not np.isfinite(check.upper):
            return f"at least {check.lower:.4g}"
        if check.lower == -check.upper:
            return f"+- {check.upper:.4g}"
        return f"{check.lower:.4g} to {check.upper:.4g}"
