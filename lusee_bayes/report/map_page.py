"""The report of a map run, out of what it has left in its folder."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from lusee_bayes.core.files import require_files
from lusee_bayes.core.layouts import Layout
from lusee_bayes.core.reading import entries
from lusee_bayes.report.rendering import render_run, rows_if_there, sentences
from lusee_bayes.report.sections import flight_section
from lusee_bayes.report.viewer import resolution, viewer
from lusee_bayes.results.diagnostics_file import GROUP
from lusee_bayes.results.finished_runs import FinishedRun
from lusee_bayes.results.saved import (
    COVERAGE,
    DIAGNOSIS,
    NULL_DIRECTION,
    POINTING,
    SOURCES,
    UNKNOWNS,
)
from lusee_bayes.sky.sky_files import SkyMap

NEEDED = ("summary.json", "spectra.csv", "scenario.yaml", "diagnostics.nc", "mean.fits", "std.fits")
# kinds of groups of data in the order of their tables, with what verdicts call them
GROUPS = {"product": "product", "day": "day", "angle": "turntable angle"}
# days in the table, the worst first
WORST_DAYS = 5


def map_page(folder: Path, name: str) -> str:
    """The page as text.

    Parameters
    ----------
    folder : Path
        With the files of a run.
    name : str
        Of the run, for the title.

    Raises
    ------
    InputError
        If something is missing in the folder.
    """
    require_files(folder, NEEDED, "map")
    run = FinishedRun.read(folder)
    summary, found = run.summary, run.diagnostics
    path = folder / "summary.json"
    unknowns = rows_if_there(folder / "unknowns.csv", UNKNOWNS)
    return render_run(
        "map.html",
        path,
        summary,
        name=name,
        level=found.attrs["level"],
        verdict=found.attrs["verdict"],
        mistakes=_entries_if_any(path, summary, "diagnosis", DIAGNOSIS),
        coverage=_entries_if_any(path, summary, "coverage", COVERAGE),
        viewer=_viewer(folder, run),
        spectra=run.spectra,
        groups=_groups(found),
        offsets=rows_if_there(folder / "pointing.csv", POINTING),
        unknowns=unknowns,
        untold=_untold(path, summary) if unknowns else [],
        sources=rows_if_there(folder / "sources.csv", SOURCES),
        flight=flight_section(folder),
    )


def _entries_if_any(
    path: Path, summary: dict[str, Any], name: str, layout: Layout
) -> list[dict[str, Any]] | None:
    """Checked objects of summary.json; None where the run has none."""
    return None if summary.get(name) is None else entries(path, summary, name, layout)


def _viewer(folder: Path, run: FinishedRun) -> dict[str, Any]:
    found = run.diagnostics
    maps = {"mean": run.mean, "std": run.std}
    if (folder / "truth.fits").is_file():
        maps["truth"] = SkyMap.read(folder / "truth.fits").pixels
    maps["prior_fraction"] = found["prior_fraction"].values
    maps |= {f"draw{k}": draw for k, draw in enumerate(found["draws"].values, 1)}
    names = ("mean", "std", "prior_fraction")
    return viewer(
        [run.summary["frequency_mhz"]],
        {key: values[None] for key, values in maps.items()},
        highest_altitude=found["highest_altitude"].values,
        regions={name: found[f"region_{name}"].values[None] for name in names},
        resolutions=[resolution(found)],
    )


def _groups(found: xr.Dataset) -> dict[str, dict[str, Any]]:
    """By kind: how many groups were left out, and the rows of those that are shown.

    There is none where there are too many data whose noise couples times: the verdict says so.
    """
    marked = {
        str(x) for key in ("suspects", "extremes") for x in np.atleast_1d(found.attrs.get(key, ()))
    }
    rows = [
        dict(zip(GROUP, row, strict=True))
        for row in zip(*(found[f"group_{name}"].values for name in GROUP), strict=True)
    ]
    shown = {}
    for kind, words in GROUPS.items():
        mine = [row for row in rows if row["kind"] == kind]
        for row in mine:
            row["bad"] = f"{words} {row['name']}" in marked
        n = len(mine)
        if kind == "day" and n > WORST_DAYS:
            mine = sorted(mine, key=lambda row: row["p"])[:WORST_DAYS]
        if mine:
            shown[kind] = {"number": n, "rows": mine}
    return shown


def _untold(path: Path, summary: dict[str, Any]) -> list[str]:
    """What the data cannot tell of receivers, ground and gain table."""
    found = {"unknowns": [summary.get("unknowns")]}
    (null,) = entries(path, found, "unknowns", NULL_DIRECTION)
    # runs of older versions have no notes
    told = [null["null_sentence"], *sentences(path, null, "notes")]
    return [sentence for sentence in told if sentence]
