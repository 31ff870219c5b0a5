"""The report of a sampled run, or of a validation, out of what it has left in its folder."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from lusee_bayes.core.files import require_files
from lusee_bayes.core.layouts import Layout, Variable
from lusee_bayes.core.reading import read_model, read_table
from lusee_bayes.judge.convergence import FAR, FEW, warnings_of
from lusee_bayes.report.rendering import render_run
from lusee_bayes.results.summaries import SamplingSummary, ValidationSummary

ROWS = ("quantity",)
SUMMARY_TABLE = Layout(
    "a summary of draws",
    {
        "quantity": Variable(ROWS, "text"),
        "mean": Variable(ROWS, finite=False),
        "sd": Variable(ROWS, finite=False),
        "r_hat": Variable(ROWS, missing=True),
    },
)


def sample_page(folder: Path, name: str) -> str:
    """The page as text, of the folder and the name of a run. InputError as :func:`.map_page`."""
    require_files(folder, ("summary.csv", "sampling.json", "scenario.yaml"), "sample")
    path, validation = folder / "sampling.json", folder / "validation.json"
    sampling = read_model(path, SamplingSummary, "the figures of a sampled run")
    quantities = read_table(folder / "summary.csv", SUMMARY_TABLE)
    worst = float(np.nanmax(quantities["r_hat"], initial=-np.inf))
    many, counts = FEW * sampling.chains * sampling.draws, {"divergences", "chains"}
    checks = None
    if validation.is_file():
        checks = read_model(validation, ValidationSummary, "the checks of a validation").checks
    return render_run(
        "sample.html",
        path,
        sampling.model_dump(),
        name=name,
        quantities=quantities,
        worst=worst if np.isfinite(worst) else None,
        reasons=warnings_of(quantities, **sampling.model_dump(include=counts)),
        bad=worst > FAR or sampling.divergences > many,
        checks=checks,
        failed=[not check.passed for check in checks or ()],
    )
