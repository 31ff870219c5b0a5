"""lusee-bayes info: what is in a file, or in the folder of a run."""

from __future__ import annotations

from pathlib import Path

from rich.console import Console


def info_command(file: Path) -> None:
    """Say what is in a file (visibilities, a posterior, samples, a sky map) or a run's folder."""
    from lusee_bayes.report.describe import describe

    Console(soft_wrap=True).print(describe(file), highlight=False, markup=False)
