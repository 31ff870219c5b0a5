"""lusee-bayes compare: finished map runs side by side."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter
from rich.console import Console

from lusee_bayes.cli.options import Force, Quiet, Verbose, say, show
from lusee_bayes.core.progress import Stages


def compare_command(
    *folders: Path,
    output: Annotated[Path, Parameter(name=["--output", "-o"])] = Path("output/comparison"),
    force: Force = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Set finished map runs side by side: maps, spectra, evidence.

    Parameters
    ----------
    folders
        Results of map, two or more.
    output
        Folder for comparison.html, comparison.csv and the figures.
    """
    from lusee_bayes.cli.tables import comparison_table
    from lusee_bayes.results.finished_runs import evidence_caveat
    from lusee_bayes.runs.compare_run import run_compare

    console = Console(quiet=quiet, soft_wrap=True)
    run = run_compare(folders, output, replace=force, stages=Stages(console, verbose=verbose))
    say(console, *(f"  {path}" for path in run.files))
    show(console, comparison_table(run.result))
    caveat = evidence_caveat(run.result)
    say(console, *([] if caveat is None else [caveat]), f"look at {output / 'comparison.html'}")
