"""Pages that set finished runs, or priors for one data set, side by side."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from lusee_bayes.core.files import require_files
from lusee_bayes.core.reading import read_model
from lusee_bayes.report.rendering import render, render_run
from lusee_bayes.results.finished_runs import FinishedRun, comparison_rows, evidence_caveat
from lusee_bayes.results.prior_comparison import PriorsSummary, prior_table


def comparison_page(runs: Sequence[FinishedRun], folder: Path) -> str:
    """The page as text; ``folder`` has the figures maps and curves."""
    pairs = zip(comparison_rows(runs), runs, strict=True)
    rows = [row | {"ell_cross": run.cross_in_words()} for row, run in pairs]
    return render("comparison.html", folder, runs=runs, rows=rows, caveat=evidence_caveat(runs))


def priors_page(folder: Path, name: str) -> str:
    """The page as text, of the folder and the name of a run. InputError as :func:`.map_page`."""
    require_files(folder, ("priors.json", "scenario.yaml", "figures/priors.png"), "compare-priors")
    path = folder / "priors.json"
    found = read_model(path, PriorsSummary, "a comparison of priors")
    header, rows = prior_table(found.priors)
    words = [(one.name, one.prior) for one in found.priors]
    shown = {"header": header, "rows": rows, "words": words, "notes": found.notes}
    return render_run("priors.html", path, found.model_dump(), name=name, **shown)
