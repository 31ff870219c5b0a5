"""Receivers, ground and gain table on the page of a run, where its folder has them."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from lusee_bayes.core.files import require_files
from lusee_bayes.core.reading import entries, read_table
from lusee_bayes.report import head, html
from lusee_bayes.results.saved import CHANNEL_UNKNOWNS, NULL_DIRECTION, UNKNOWNS

TITLE = "Receivers, ground and gain table"
HEADER = ("unknown", "unit", "found", "+-", "before the data", "+-")


def map_unknowns(folder: Path, summary: Mapping[str, Any]) -> list[str]:
    """Those of a map, and what its data cannot tell."""
    if not (folder / "unknowns.csv").is_file():
        return []
    table = read_table(folder / "unknowns.csv", UNKNOWNS)
    null = entries(
        folder / "summary.json", {"unknowns": [summary.get("unknowns")]}, "unknowns", NULL_DIRECTION
    )[0]
    # runs of older versions have no notes
    notes = head.sentences(folder / "summary.json", null, "notes")
    told = [sentence for sentence in (null["null_sentence"], *notes) if sentence]
    parts = [html.subsection(TITLE), html.table(HEADER, _cells(table))]
    return [*parts, *map(html.paragraph, told)]


def cube_unknowns(folder: Path, summary: Mapping[str, Any]) -> list[str]:
    """Those of every channel: what data cannot tell, a figure against frequency, and a table."""
    if not (folder / "unknowns.csv").is_file():
        return []
    require_files(folder, ("figures/unknowns.png",), "map")
    table = read_table(folder / "unknowns.csv", CHANNEL_UNKNOWNS)
    cells = zip(table["frequency_mhz"], _cells(table), strict=True)
    rows = [(f"{frequency:g}", *row) for frequency, row in cells]
    figure = html.figure(
        folder / "figures" / "unknowns.png",
        "Powers of receivers, temperature of the ground and errors of gains against frequency",
        "What was found of each in every channel, with one standard deviation; grey: before the "
        "data. What is as wide as before was not told by them.",
    )
    return [
        html.subsection(TITLE),
        *map(html.paragraph, head.sentences(folder / "summary.json", summary, "unknowns")),
        figure,
        html.folded("all of them", html.table(("MHz", *HEADER), rows)),
    ]


def _cells(table: Mapping[str, np.ndarray]) -> list[tuple[str, ...]]:
    return [
        (name, unit or "relative", f"{value:.5g}", f"{std:.2g}", f"{prior:.5g}", f"{before:.2g}")
        for name, unit, value, std, prior, before in zip(
            *(table[name] for name in UNKNOWNS.variables), strict=True
        )
    ]
