"""The part of a report that says how spectra became visibilities."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from lusee_bayes.core.checks import counted
from lusee_bayes.flight.reduced import REASONS, Reduced, read_reduced
from lusee_bayes.report import html
from lusee_bayes.results.saved import REDUCED

SECTION = ("flight", "From counts to visibilities")
FIGURES = {
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


def is_flight(folder: Path) -> bool:
    """Whether a run was made of flight data."""
    return (folder / REDUCED).is_file()


def flight_section(folder: Path) -> str:
    """The section: sessions, gains, flags, noise.

    Parameters
    ----------
    folder : Path
        Of a run of flight data.
    """
    reduced = read_reduced(folder / REDUCED)
    figures = [
        html.figure(path, alternative, caption)
        for name, (alternative, caption) in FIGURES.items()
        if (path := folder / "figures" / f"{name}.png").is_file()
    ]
    return html.section(*SECTION, *_sessions(reduced), *_flags(reduced), *figures)


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
