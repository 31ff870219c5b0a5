"""lusee-bayes info: what is in a file."""

from __future__ import annotations

from pathlib import Path

from rich.console import Console

from lusee_bayes.report.describe import describe


def info_command(file: Path) -> None:
    """Say what is in a file: visibilities, a posterior, samples, or a sky map.

    Example: lusee-bayes info output/fiducial/posterior.nc
    """
    Console(soft_wrap=True).print(describe(file), highlight=False, markup=False)
