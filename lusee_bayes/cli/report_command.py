"""lusee-bayes report: the page of a finished run, made again."""

from __future__ import annotations

from pathlib import Path

from rich.console import Console

from lusee_bayes.cli.options import Quiet


def report_command(folder: Path, *, quiet: Quiet = False) -> None:
    """Write report.html again from the results in the folder of a run.

    Parameters
    ----------
    folder
        Results of map, sample or validate.
    """
    from lusee_bayes.report.pages import write_report

    path = write_report(folder)
    Console(quiet=quiet, soft_wrap=True).print(f"look at {path}", highlight=False, markup=False)
