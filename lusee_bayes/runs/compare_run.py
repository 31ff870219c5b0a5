"""Comparisons: of finished map runs, and of one data set mapped under several priors."""

from collections.abc import Sequence
from pathlib import Path

from lusee_bayes.core.progress import Stages
from lusee_bayes.report.figures.maps import map_fidelity, maps_of_runs
from lusee_bayes.report.pages import write_comparison
from lusee_bayes.results.finished_runs import FinishedRun, comparison_rows, read_runs
from lusee_bayes.runs.folder import Output, RunKind, RunOutcome, run_folder


def run_compare(
    folders: Sequence[str | Path],
    folder: str | Path,
    *,
    replace: bool = False,
    stages: Stages | None = None,
) -> RunOutcome[list[FinishedRun]]:
    """Compare finished map runs, and write page, table and figures in one transaction.

    Parameters
    ----------
    folders : sequence of paths
        Folders of two or more finished map runs.
    folder : path
        Folder of the results.
    replace, stages : bool and Stages, optional
        As in :func:`.run_map`.

    Raises
    ------
    InputError
        For fewer than two folders, or one that is not the folder of a finished map run.
    """
    with run_folder(folder, COMPARISON, None, None, *folders, replace=replace) as run:
        return run.write(read_runs(folders), stages or Stages())


# contents of the folder of a comparison; a new file is one line here
COMPARISON = RunKind(
    "compare",
    outputs=(Output(write_comparison), Output.rows("comparison.csv", comparison_rows)),
    figures={
        "maps": maps_of_runs,
        "curves": lambda runs: map_fidelity({run.name: run.channel for run in runs}),
    },
    dpi=100,
)
