"""A comparison: finished map runs side by side."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from lusee_bayes.core.progress import Stages
from lusee_bayes.core.reading import write_csv
from lusee_bayes.report.comparison_page import comparison_page
from lusee_bayes.report.figures import comparison as comparison_figures
from lusee_bayes.results.finished_runs import FinishedRun, comparison_rows, read_runs
from lusee_bayes.runs.folder import FIGURES, Output, Run, RunKind, run_folder, write_run
from lusee_bayes.runs.origins import origin_of


def run_compare(
    folders: Sequence[str | Path],
    folder: str | Path,
    *,
    replace: bool = False,
    stages: Stages | None = None,
) -> Run[list[FinishedRun]]:
    """Set finished map runs side by side, and write page, table and figures in one transaction.

    Parameters
    ----------
    folders : sequence of paths
        Of finished map runs, two or more.
    folder : path
        Of the results.
    replace : bool
        Replace results of another run in the folder.
    stages : Stages, optional
        Told what is being done.

    Raises
    ------
    InputError
        For fewer than two folders, or one that is not of a finished map run.
    """
    stages = stages or Stages()
    origin = origin_of()
    with run_folder(folder, COMPARISON, origin, replace=replace, inputs=folders) as place:
        return write_run(place, read_runs(folders), COMPARISON, origin, stages)


def _write_page(runs: list[FinishedRun], folder: Path) -> None:
    (folder / "comparison.html").write_text(
        comparison_page(runs, folder / FIGURES), encoding="utf-8"
    )


# what the folder of a comparison holds; a new file is one line here
COMPARISON = RunKind(
    "compare",
    outputs=(
        Output(_write_page),
        Output(lambda runs, folder: write_csv(folder / "comparison.csv", comparison_rows(runs))),
    ),
    figures={"maps": comparison_figures.maps, "curves": comparison_figures.curves},
    dpi=100,
)
