"""What sections of the pages of maps and cubes show: how spectra became visibilities."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from lusee_bayes.flight.reduced import REASONS, Reduced, read_reduced
from lusee_bayes.results.saved import REDUCED


def flight_section(folder: Path) -> dict[str, Any] | None:
    """Sessions, flags and noise as ``flight.html`` shows them; None for other data.

    Parameters
    ----------
    folder : Path
        Of a run.
    """
    if not (folder / REDUCED).is_file():
        return None
    reduced = read_reduced(folder / REDUCED)
    reasons = [k for k in range(len(REASONS)) if not k or (reduced.reason == k).any()]
    return {
        "reduced": reduced,
        "reasons": [REASONS[k] for k in reasons],
        "bands": [_band(reduced, band, reasons) for band in range(len(reduced.frequencies_mhz))],
    }


def _band(reduced: Reduced, band: int, reasons: list[int]) -> dict[str, Any]:
    """Shares of the spectra by reason, of the flagged channels of those used, and the noise."""
    used = reduced.reason[band] == 0
    return {
        "frequency_mhz": reduced.frequencies_mhz[band],
        "shares": [(reduced.reason[band] == k).mean() for k in reasons],
        "flagged": reduced.lines[band][used].mean() if used.any() else np.nan,
        "scatter": reduced.scatter[band],
        "line_scatter": reduced.line_scatter[band],
        "doubts": reduced.doubts(band),
    }
