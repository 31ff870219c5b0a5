"""The report of a map run with one or several channels, made from the files in its folder."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from lusee_bayes.core.files import require_files
from lusee_bayes.core.harmonics import lmax_of
from lusee_bayes.flight.reduced import REASONS, REDUCED, Reduced, read_reduced
from lusee_bayes.judge.chi2 import ChiSquare, stands_out
from lusee_bayes.judge.cube_fit import N_TESTS
from lusee_bayes.judge.left_out import KINDS
from lusee_bayes.report.figures.drawing import taper_fwhm_deg
from lusee_bayes.report.rendering import render_run
from lusee_bayes.report.viewer import viewer
from lusee_bayes.results.channel import Judged
from lusee_bayes.results.finished_runs import FinishedRun
from lusee_bayes.results.sky_spectrum import SkySpectrum

# number of days in the table, worst first
WORST_DAYS = 5


def map_page(folder: Path, name: str) -> str:
    """The page of a map as text.

    Parameters
    ----------
    folder : Path
        With the files of a run.
    name : str
        Name of the run, for the title.

    Raises
    ------
    InputError
        If a file is missing in the folder.
    """
    require_files(folder, ("summary.json", "scenario.yaml", "diagnostics.nc"), "map")
    run = FinishedRun.read(folder)
    summary, channels = run.summary, run.channels
    tests = N_TESTS * len(channels)
    return render_run(
        "map.html",
        folder / "summary.json",
        summary.model_dump(),
        name=name,
        channels=channels,
        judged=[_groups(c.judged) for c in channels],
        unfit=[test.level != "consistent" for test in summary.tests],
        bad=[stands_out(channel.instrument.p, tests) for channel in channels],
        regions=_regions(run),
        viewer=viewer(name, channels),
        smoothing_deg=taper_fwhm_deg(max(lmax_of(len(channels[0].mean)), 1)),
        flight=flight_section(folder),
    )


def _regions(run: FinishedRun) -> list[tuple[str, ChiSquare]]:
    """chi^2 of each region's spectrum; empty for one channel and unless the truth is known."""
    temperatures = [channel.temperatures for channel in run.channels]
    spectrum = SkySpectrum.of(run.summary.frequencies_mhz, temperatures)
    if len(temperatures) == 1 or spectrum is None or spectrum.truth is None:
        return []
    return [(region, spectrum.chi2(region)) for region in spectrum.regions]


def _groups(judged: Judged | None) -> dict[str, dict[str, Any]]:
    """By kind: the number of groups tested, and those shown, with the bad ones marked.

    Empty if noise couples too many data in time for tests of groups (the verdict notes it).
    """
    shown: dict[str, dict[str, Any]] = {}
    if judged is None:
        return shown
    marked = {*judged.suspects, *judged.extremes}
    for kind in KINDS:
        listed = groups = judged.of_kind(kind)
        if kind == "day" and len(listed) > WORST_DAYS:
            listed = sorted(listed, key=lambda group: group.p)[:WORST_DAYS]
        if listed:
            bad = [str(group) in marked for group in listed]
            shown[kind] = {"number": len(groups), "rows": listed, "bad": bad}
    return shown


def flight_section(folder: Path) -> dict[str, Any] | None:
    """Sessions, flags and noise as ``flight.html`` shows them; None for other data.

    Parameters
    ----------
    folder : Path
        Folder of a run.
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
    """Shares of spectra by reason, the share of flagged channels in used ones, and the noise."""
    used = reduced.reason[band] == 0
    return {
        "frequency_mhz": reduced.frequencies_mhz[band],
        "shares": [(reduced.reason[band] == k).mean() for k in reasons],
        "flagged": reduced.lines[band][used].mean() if used.any() else np.nan,
        "scatter": reduced.scatter[band],
        "line_scatter": reduced.line_scatter[band],
        "doubts": reduced.doubts(band),
    }
