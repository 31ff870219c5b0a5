"""Which report a folder gets, and writing it."""

from __future__ import annotations

import json
from pathlib import Path

from lusee_bayes.checks import InputError
from lusee_bayes.report.cube_report import cube_report
from lusee_bayes.report.map_report import map_report
from lusee_bayes.report.sample_report import sample_report
from lusee_bayes.staging import replacing

REPORT = "report.html"


def _is_cube(folder: Path) -> bool:
    summary = folder / "summary.json"
    return summary.is_file() and "frequencies_mhz" in json.loads(summary.read_text())


def write_report(folder: str | Path) -> Path:
    """Write report.html of the results in a folder, whole or not at all.

    InputError if the folder does not hold the results of ``map``, ``sample`` or ``validate``.
    """
    folder = Path(folder)
    if (folder / "posterior.nc").is_file():
        text = cube_report(folder) if _is_cube(folder) else map_report(folder)
    elif (folder / "samples.nc").is_file():
        text = sample_report(folder)
    else:
        raise InputError(
            f"'{folder}' holds neither posterior.nc (lusee-bayes map) nor samples.nc (lusee-bayes "
            "sample, validate); give the folder of a finished run"
        )
    path = folder / REPORT
    with replacing(path) as partial:
        partial.write_text(text)
    return path
