"""Pages that set finished runs, or priors for one data set, side by side."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from lusee_bayes.core.errors import InputError
from lusee_bayes.core.files import require_files
from lusee_bayes.core.reading import entries, read_json
from lusee_bayes.report.rendering import render, render_run, sentences
from lusee_bayes.results.finished_runs import FinishedRun, comparison_rows, evidence_caveat
from lusee_bayes.results.prior_comparison import prior_table
from lusee_bayes.results.saved import COVERAGE, HELD_OUT, PRIOR, PRIORS, SKY_ERRORS, SNR


def comparison_page(runs: Sequence[FinishedRun], folder: Path) -> str:
    """The page as text; ``folder`` has the figures maps and curves."""
    pairs = zip(comparison_rows(runs), runs, strict=True)
    rows = [row | {"ell_cross": run.cross_in_words()} for row, run in pairs]
    return render("comparison.html", folder, runs=runs, rows=rows, caveat=evidence_caveat(runs))


def priors_page(folder: Path, name: str) -> str:
    """The page as text, of the folder and the name of a run. InputError as :func:`.map_page`."""
    require_files(folder, ("priors.json", "scenario.yaml", "figures/priors.png"), "compare-priors")
    path = folder / "priors.json"
    found = read_json(path, PRIORS)
    priors = _priors(path, found)
    header, rows = prior_table(priors)
    return render_run(
        "priors.html",
        path,
        found,
        name=name,
        notes=sentences(path, {"notes": None} | found, "notes"),
        header=header,
        rows=rows,
        words=[(one["name"], one["prior"]) for one in priors],
    )


def _priors(path: Path, found: dict[str, Any]) -> list[dict[str, Any]]:
    """The entries, checked as deep as the table reads them."""
    priors = entries(path, found, "priors", PRIOR)
    if not priors:
        raise InputError(f"{path} has no prior; make the results anew")
    lengths = set()
    for one in priors:
        held = entries(path, one, "held_out", HELD_OUT)
        known = one.get("coverage") is not None
        parts = entries(path, one, "coverage", COVERAGE) if known else []
        errors = entries(path, one, "errors", SKY_ERRORS) if known else []
        snr = entries(path, one, "snr", SNR)
        lengths.add(tuple(map(len, (held, parts, errors, snr))))
    if len(lengths) > 1:
        raise InputError(f"{path}: its priors tell different things; make the results anew")
    return priors
