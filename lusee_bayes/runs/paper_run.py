"""Reproduction of the reference paper: cases computed once, then figures and tested claims."""

from collections.abc import Sequence
from pathlib import Path

import xarray as xr

from lusee_bayes.core import files, formats, progress
from lusee_bayes.core.engine import Engine, Tasks, ThisProcess
from lusee_bayes.paper.cases import case_table, compute_case, is_case, paper_scenarios
from lusee_bayes.paper.claims import Cases, claim_table
from lusee_bayes.paper.figures import FIGURES
from lusee_bayes.report.rendering import render_text
from lusee_bayes.runs.folder import Output, RunKind, RunOutcome, run_folder

CASES, UNFINISHED = "cases", "unfinished-cases"


def run_paper(
    folder: str | Path,
    overrides: Sequence[str] = (),
    skies: Sequence[str | Path] = (),
    engine: Engine | None = None,
    replace: bool = False,
    stages: progress.Stages | None = None,
) -> RunOutcome[Cases]:
    """Compute the paper's missing cases, then draw the figures and test the claims.

    Cases computed earlier with the same scenario and version are kept. The folder changes in one
    transaction, once all cases are complete.

    Parameters
    ----------
    folder : path
        Folder of the results.
    overrides : sequence of str
        ``key.path=value``, applied to every case.
    skies : sequence of paths
        ULSA HDF5 files with the frequency in their names; each case scales the nearest one.
    engine : Engine, optional
        Where cases are computed; by default in this process.
    replace, stages : bool and Stages, optional
        As in :func:`.run_map`.

    Raises
    ------
    InputError
        For skies without a frequency in their names, and for invalid overrides.
    """
    engine, stages = engine or ThisProcess(), stages or progress.Stages()
    scenarios = paper_scenarios(overrides, skies)
    with run_folder(folder, PAPER, replace=replace) as run:
        engine.work_in(run.path)
        # workers may have another working directory
        home = run.path.resolve()

        def computed(name: str) -> Path:
            """The file of a case, which is computed if no file contains it."""
            for path in (home / place / f"{name}.nc" for place in (CASES, UNFINISHED)):
                if is_case(path, scenarios[name]):
                    return path
            with files.replacing(path) as partial:
                formats.write_netcdf(compute_case(scenarios[name]), partial)
            return path

        names = list(scenarios)
        paths = engine.each(Tasks(computed, names, names), stages, "cases")
        kept = [xr.load_dataset(path, engine="h5netcdf") for path in paths]
        return run.write(dict(zip(names, kept, strict=True)), stages)


def _write_cases(cases: Cases, folder: Path) -> None:
    (folder / CASES).mkdir()
    for name, case in cases.items():
        formats.write_netcdf(case, folder / CASES / f"{name}.nc")


# contents of the folder of the paper's run; a new file is one line here
PAPER = RunKind(
    "paper",
    outputs=(
        Output(_write_cases),
        Output.rows("cases.csv", case_table),
        Output.rows("claims.csv", lambda cases: claim_table(cases)),
        Output.text("claims.md", lambda cases: render_text("claims.md", rows=claim_table(cases))),
    ),
    figures=FIGURES,
    unfinished=UNFINISHED,
    resume="the same command continues from the finished cases",
)
