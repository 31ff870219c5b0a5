"""report.html: one file that says of a run what a person wants to know of it."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

from lusee_bayes.core.errors import InputError
from lusee_bayes.core.files import read_manifest, recover, replacing
from lusee_bayes.report.comparison_page import priors_page
from lusee_bayes.report.map_page import map_page
from lusee_bayes.report.sample_page import sample_page

REPORT = "report.html"
# by the kind of run: the page as text, of a folder and the run's name
PAGES: dict[str, Callable[[Path, str], str]] = {
    "map": map_page,
    "sample": sample_page,
    "validate": sample_page,
    "compare-priors": priors_page,
}


def write_report(folder: str | Path) -> Path:
    """Write report.html of the results in a folder again, whole or not at all.

    Raises
    ------
    InputError
        If the folder does not hold the results of ``map``, ``sample`` or ``validate``.
    """
    folder = Path(folder)
    if not os.path.isdir(folder):
        raise InputError(f"'{folder}' is no folder; give the folder of a finished run")
    recover(folder)
    kind = _kind(folder)
    if kind not in PAGES:
        raise InputError(
            f"'{folder}' holds neither posterior.nc (lusee-bayes map) nor samples.nc (lusee-bayes "
            "sample, validate); give the folder of a finished run"
        )
    path = folder / REPORT
    with replacing(path) as partial:
        partial.write_text(PAGES[kind](folder, folder.resolve().name), encoding="utf-8")
    return path


def _kind(folder: Path) -> str | None:
    """The kind of run whose results a folder holds."""
    manifest = read_manifest(folder)
    if manifest is not None:
        return manifest["kind"]
    # folders that were written before there were manifests
    if (folder / "samples.nc").is_file():
        return "sample"
    return "map" if (folder / "posterior.nc").is_file() else None
