"""Sections of the pages of maps and cubes: unknowns, and how spectra became visibilities."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from lusee_bayes.core.checks import counted
from lusee_bayes.core.files import require_files
from lusee_bayes.core.reading import entries, read_table
from lusee_bayes.flight.reduced import REASONS, Reduced, read_reduced
from lusee_bayes.report import html
from lusee_bayes.results.saved import CHANNEL_UNKNOWNS, NULL_DIRECTION, REDUCED, UNKNOWNS

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
    notes = html.sentences(folder / "summary.json", null, "notes")
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
        folder,
        "unknowns",
        "Powers of receivers, temperature of the ground and errors of gains against frequency",
        "What was found of each in every channel, with one standard deviation; grey: before the "
        "data. What is as wide as before was not told by them.",
    )
    return [
        html.subsection(TITLE),
        *map(html.paragraph, html.sentences(folder / "summary.json", summary, "unknowns")),
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


FLIGHT_FIGURES = {
    "flight_time_line": (
        "Gain level of every port and flagged spectra, over time",
        "The gain of every port, and the spectra that are not used, by reason.",
    ),
    "flight_waterfall": (
        "The 16 products over time, before and after flags",
        "Products after flags (blue), and before where something is flagged (orange). Imaginary "
        "parts are below the diagonal.",
    ),
    "flight_calibration": (
        "Gain curves with their errors, and measured over expected noise by frequency",
        "Gains of the levels that the spectra have, and the scatter of spectra and channels over "
        "what the radiometer equation expects.",
    ),
}
SESSION = ("file", "layout", "spectra", "integration [s]", "Navgf", "gains", "software", "clock")


def flight_section(folder: Path) -> dict[tuple[str, str], list[str]]:
    """Sessions, gains, flags and noise, by anchor and title; nothing for other data.

    Parameters
    ----------
    folder : Path
        Of a run.
    """
    if not (folder / REDUCED).is_file():
        return {}
    reduced = read_reduced(folder / REDUCED)
    figures = [
        html.figure(folder, name, *texts)
        for name, texts in FLIGHT_FIGURES.items()
        if html.figure_path(folder, name).is_file()
    ]
    parts = [*_sessions(reduced), *_flags(reduced), *figures]
    return {("flight", "From counts to visibilities"): parts}


def _sessions(reduced: Reduced) -> list[str]:
    rows = [
        (
            Path(one["file"]).name,
            f"{one['kind']} {one['layout']}",
            one["spectra"],
            f"{one['window_s']:.6g}",
            ", ".join(map(str, one["navgf"])),
            ", ".join(one["levels"]),
            one["software"],
            _clock(one),
        )
        for one in reduced.sessions
    ]
    length = "bins of one spectrum each"
    if reduced.average_s is not None:
        length = f"bins of {reduced.average_s:g} s, which end where the gains change"
    # files of older versions do not say how they were reduced
    seen = reduced.observation
    site = f"longitude {seen.lon_deg:g}°, latitude {seen.lat_deg:g}°"
    how = {**reduced.recipe, "site": f"{site}, {reduced.recipe.get('site', '')}".rstrip(", ")}
    return [
        html.paragraph(
            f"{counted(len(reduced.bin_of), 'spectrum', 'spectra')} of "
            f"{counted(len(rows), 'session')}, in bands of "
            f"{reduced.bandwidth_mhz:g} MHz and {length}."
        ),
        html.definitions(list(how.items())),
        html.table(SESSION, rows),
        *(html.paragraph(note) for note in reduced.notes()),
    ]


def _clock(session: Mapping[str, Any]) -> str:
    """Scale and rate of a session's clock, and where they are from."""
    scale, rate = session.get("scale"), session.get("rate", 1.0)
    parts = [scale.upper()] if scale else []
    parts += [f"rate {rate:.12g}"] if rate != 1.0 else []
    return ", ".join([*parts, f"of the {session['clock']}"])


def _flags(reduced: Reduced) -> list[str]:
    reasons = [k for k in range(len(REASONS)) if not k or (reduced.reason == k).any()]
    header = (
        "band [MHz]",
        *(REASONS[k] for k in reasons),
        "channels flagged",
        "scatter in time",
        "scatter of channels",
    )
    rows = []
    for band, frequency in enumerate(reduced.frequencies_mhz):
        share = [f"{(reduced.reason[band] == k).mean():.2%}" for k in reasons]
        used = reduced.reason[band] == 0
        lines = reduced.lines[band][used].mean() if used.any() else np.nan
        numbers = (reduced.scatter[band], reduced.line_scatter[band])
        told = ["not known" if np.isnan(x) else f"{x:.3f}" for x in numbers]
        rows.append((f"{frequency:g}", *share, f"{lines:.2%}", *told))
    return [
        html.subsection("Flags and noise"),
        html.paragraph(
            "Shares of the spectra of each band. Scatter is over that of the radiometer equation: "
            "1 where nothing else than noise is left. In time, bursts are looked for, and scatter "
            "is known, where four hours have 16 spectra or more."
        ),
        html.table(header, rows),
        *(
            html.paragraph(f"{frequency:g} MHz: {text}")
            for band, frequency in enumerate(reduced.frequencies_mhz)
            for text in reduced.doubts(band)
        ),
    ]
