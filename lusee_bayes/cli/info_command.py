"""lusee-bayes info: what is in a file."""

from __future__ import annotations

from pathlib import Path

from rich.console import Console


def info_command(file: Path) -> None:
    """Say what is in a file: visibilities, a posterior, samples, or a sky map."""
    from lusee_bayes.report.describe import describe

    Console(soft_wrap=True).print(describe(file), highlight=False, markup=False)
