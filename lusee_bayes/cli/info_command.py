"""lusee-bayes info: what is in files, or in the folders of runs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter
from rich.console import Console

from lusee_bayes.core.errors import InputError


def info_command(files: Annotated[list[Path], Parameter(required=True)], /) -> int:
    """Say what is in files (visibilities, sessions, a posterior, samples, a sky) or runs' folders.

    Parameters
    ----------
    files
        One or several; one that cannot be read is named, and the others are shown.
    """
    from lusee_bayes.report.describe import describe

    console, errors = Console(soft_wrap=True), Console(stderr=True, soft_wrap=True)
    refused = 0
    for number, file in enumerate(files):
        try:
            told = describe(file)
        except InputError as error:
            errors.print(f"lusee-bayes: {error}", highlight=False, markup=False)
            refused += 1
        else:
            # a part for each
            console.print(f"\n{told}" if number else told, highlight=False, markup=False)
    return 2 if refused else 0
