"""Coverage as a table, for the pages of maps and of given skies."""

from __future__ import annotations

from collections.abc import Mapping

from lusee_bayes.linear.levels import LEVELS, NAMES

COVERAGE_HEADER = (
    "",
    *(f"{level:.0%} intervals" for level in LEVELS),
    "rms pull",
    "largest",
)


def coverage_cells(row: Mapping[str, float | str]) -> tuple[str, ...]:
    """The cells of one part of the sky, as summary.json and coverage.json have it."""
    held = (f"{row[f'held_{n}']:.1%} ± {100 * row[f'scatter_{n}']:.1f}" for n in NAMES)
    return (
        str(row["name"]),
        *held,
        f"{row['rms']:.2f} ± {row['rms_scatter']:.2f}",
        f"{row['largest']:.1f} ({row['allowed']:.1f})",
    )
