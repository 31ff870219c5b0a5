"""lusee-bayes compare: finished map runs side by side."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter
from rich.console import Console
from rich.table import Table

from lusee_bayes import side_by_side_plots
from lusee_bayes.commands.options import Quiet, Verbose
from lusee_bayes.finished_runs import read_runs, same_data, table
from lusee_bayes.progress import Stages
from lusee_bayes.report import comparison_report
from lusee_bayes.staging import staged


def compare_command(
    *folders: Path,
    output: Annotated[Path, Parameter(name=["--output", "-o"])] = Path("output/comparison"),
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Set finished map runs side by side: maps, spectra, evidence.

    Example: lusee-bayes compare output/fiducial output/gain_1e-2

    Parameters
    ----------
    folders
        Results of map, two or more.
    output
        Folder for comparison.html, comparison.csv and the figures.
    quiet
        Print nothing but errors.
    verbose
        Tell the memory in use after every stage.
    """
    console = Console(quiet=quiet, soft_wrap=True)
    stages = Stages(console, verbose=verbose)
    runs = read_runs(folders)
    rows = table(runs)
    with stages("figures"), staged(output) as stage:
        (stage / "figures").mkdir()
        for name in ("maps", "curves"):
            figure = getattr(side_by_side_plots, name)(runs)
            figure.savefig(stage / "figures" / f"{name}.png", dpi=100)
        (stage / "comparison.html").write_text(comparison_report(runs, stage / "figures"))
        with (stage / "comparison.csv").open("w", newline="") as file:
            writer = csv.DictWriter(file, list(rows[0]))
            writer.writeheader()
            writer.writerows(rows)
    shown = Table("run", "SNR < 1 from ell", "bits", "ln evidence", "less the best", "p")
    for row in rows:
        shown.add_row(
            str(row["run"]),
            str(row["ell_cross"]),
            f"{row['information_bits']:.0f}",
            f"{row['log_evidence']:.1f}",
            f"{row['log_evidence_less_best']:.1f}",
            f"{row['p']:.2g}",
        )
    console.print(shown)
    if not same_data(runs):
        console.print("different data: the evidences cannot be compared with each other")
    console.print(f"look at {output / 'comparison.html'}", highlight=False)
