"""report.html, the results of a run on one page, and pages that compare runs."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from lusee_bayes.core.errors import InputError
from lusee_bayes.core.files import read_manifest, recover, replacing, require_files
from lusee_bayes.core.layouts import Layout, Variable
from lusee_bayes.core.reading import read_model, read_table
from lusee_bayes.judge.convergence import FAR, FEW, warnings_of
from lusee_bayes.report.map_page import map_page
from lusee_bayes.report.rendering import render, render_run
from lusee_bayes.results.finished_runs import FinishedRun, comparison_rows, evidence_caveat
from lusee_bayes.results.prior_comparison import PriorsSummary, prior_table
from lusee_bayes.results.summaries import SamplingSummary, ValidationSummary

ROWS = ("quantity",)
SUMMARY_COLUMNS = {
    "quantity": Variable(ROWS, "text"),
    **dict.fromkeys(("mean", "sd"), Variable(ROWS, finite=False)),
    "r_hat": Variable(ROWS, missing=True),
}
SUMMARY_TABLE = Layout("a summary of draws", SUMMARY_COLUMNS)


def sample_page(folder: Path, name: str) -> str:
    """The page of a sampled run as text, from its folder. InputError as :func:`.map_page`."""
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


def comparison_page(runs: Sequence[FinishedRun], folder: Path) -> str:
    """The page of a comparison of runs as text; ``folder`` has its figures."""
    pairs = zip(comparison_rows(runs), runs, strict=True)
    rows = [row | {"ell_cross": run.cross_in_words()} for row, run in pairs]
    return render("comparison.html", folder, runs=runs, rows=rows, caveat=evidence_caveat(runs))


def priors_page(folder: Path, name: str) -> str:
    """The page of a comparison of priors as text. InputError as :func:`.map_page`."""
    require_files(folder, ("priors.json", "scenario.yaml", "figures/priors.png"), "compare-priors")
    path = folder / "priors.json"
    comparison = read_model(path, PriorsSummary, "a comparison of priors")
    header, rows = prior_table(comparison.priors)
    words = [(one.name, one.prior) for one in comparison.priors]
    shown = {"header": header, "rows": rows, "words": words, "notes": comparison.notes}
    return render_run("priors.html", path, comparison.model_dump(), name=name, **shown)


REPORT = "report.html"
# by kind of run: makes the page as text, from the folder and the name of the run
PAGES: dict[str, Callable[[Path, str], str]] = {
    "map": map_page,
    "sample": sample_page,
    "validate": sample_page,
    "compare-priors": priors_page,
}


def write_report(folder: str | Path) -> Path:
    """Rewrite report.html in the folder of a finished run, completely or not at all.

    Raises
    ------
    InputError
        If the folder has no results of a kind with a page (``PAGES``).
    """
    folder = Path(folder)
    if not os.path.isdir(folder):
        raise InputError(f"'{folder}' is not a folder; give the folder of a finished run")
    recover(folder)
    manifest, old = read_manifest(folder), {"samples.nc": "sample", "posterior.nc": "map"}
    # folders of earlier versions have no manifest
    guessed = [kind for name, kind in old.items() if (folder / name).is_file()]
    kind = manifest["kind"] if manifest is not None else next(iter(guessed), None)
    if kind not in PAGES:
        raise InputError(
            f"'{folder}' has neither posterior.nc (lusee-bayes map) nor samples.nc (lusee-bayes "
            "sample, validate); give the folder of a finished run"
        )
    path = folder / REPORT
    with replacing(path) as partial:
        partial.write_text(PAGES[kind](folder, folder.resolve().name), encoding="utf-8")
    return path
