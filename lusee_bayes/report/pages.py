"""report.html, the results of a run on one page, and pages that compare runs."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from lusee_bayes.core import files, harmonics, layouts
from lusee_bayes.core.errors import InputError
from lusee_bayes.core.reading import read_model, read_table
from lusee_bayes.flight.reduced import REASONS, REDUCED, Reduced, read_reduced
from lusee_bayes.judge import convergence, left_out
from lusee_bayes.judge.chi2 import ChiSquare, stands_out
from lusee_bayes.judge.cube_fit import N_TESTS
from lusee_bayes.report.rendering import render, render_run
from lusee_bayes.report.viewer import viewer
from lusee_bayes.results.channel import Judged
from lusee_bayes.results.finished_runs import FinishedRun, comparison_rows, evidence_caveat
from lusee_bayes.results.summaries import MapSummary, SamplingSummary, ValidationSummary

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
    run = FinishedRun.read(folder)
    summary = read_model(folder / "summary.json", MapSummary, "the figures of a map run")
    channels = run.channels
    return render_run(
        "map.html",
        folder / "summary.json",
        summary.model_dump(),
        name=name,
        channels=channels,
        judged=[_groups(c.judged) for c in channels],
        unfit=[test.level != "consistent" for test in summary.tests],
        bad=[stands_out(channel.instrument.p, N_TESTS * len(channels)) for channel in channels],
        regions=_regions(run),
        viewer=viewer(name, channels),
        smoothing_deg=harmonics.taper_fwhm_deg(max(harmonics.lmax_of(len(channels[0].mean)), 1)),
        flight=flight_section(folder),
    )


def _regions(run: FinishedRun) -> list[tuple[str, ChiSquare]]:
    """chi^2 of each region's spectrum; empty for one channel and unless the truth is known."""
    if len(run.channels) == 1 or any(channel.truth is None for channel in run.channels):
        return []
    spectrum = run.sky_spectrum()
    return [(region, spectrum.chi2(region)) for region in spectrum.regions]


def _groups(judged: Judged | None) -> dict[str, dict[str, Any]]:
    """By kind: the number of groups tested, and those shown, with the bad ones marked.

    Empty if noise couples too many data in time for tests of groups (the verdict notes it).
    """
    shown: dict[str, dict[str, Any]] = {}
    if judged is None:
        return shown
    marked = {*judged.suspects, *judged.extremes}
    for kind in left_out.KINDS:
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


ROWS = ("quantity",)
SUMMARY_COLUMNS = {
    "quantity": layouts.Variable(ROWS, "text"),
    **dict.fromkeys(("mean", "sd"), layouts.Variable(ROWS, finite=False)),
    "r_hat": layouts.Variable(ROWS, missing=True),
}
SUMMARY_TABLE = layouts.Layout("a summary of draws", SUMMARY_COLUMNS)


def sample_page(folder: Path, name: str) -> str:
    """The page of a sampled run as text, from its folder. InputError as :func:`.map_page`."""
    files.require_files(folder, ("summary.csv", "sampling.json", "scenario.yaml"), "sample")
    path, validation = folder / "sampling.json", folder / "validation.json"
    sampling = read_model(path, SamplingSummary, "the figures of a sampled run")
    quantities = read_table(folder / "summary.csv", SUMMARY_TABLE)
    worst = float(np.nanmax(quantities["r_hat"], initial=-np.inf))
    many, counts = convergence.FEW * sampling.chains * sampling.draws, {"divergences", "chains"}
    checks = None
    if validation.is_file():
        checks = read_model(validation, ValidationSummary, "the checks of a validation").checks
    return render_run(
        "sample.html",
        path,
        sampling.model_dump(),
        name=name,
        quantities=quantities,
        worst=worst if np.isfinite(worst) else None,
        reasons=convergence.warnings_of(quantities, **sampling.model_dump(include=counts)),
        bad=worst > convergence.FAR or sampling.divergences > many,
        checks=checks,
        failed=[not check.passed for check in checks or ()],
    )


def write_comparison(runs: Sequence[FinishedRun], folder: Path) -> None:
    """Write the page of a comparison of runs into the folder of its figures."""
    pairs = zip(comparison_rows(runs), runs, strict=True)
    rows = [row | {"ell_cross": run.cross_in_words()} for row, run in pairs]
    page = render("comparison.html", folder, runs=runs, rows=rows, caveat=evidence_caveat(runs))
    (folder / "comparison.html").write_text(page, encoding="utf-8")


REPORT = "report.html"
# by kind of run: makes the page as text, from the folder and the name of the run
PAGES: dict[str, Callable[[Path, str], str]] = {
    "map": map_page,
    "sample": sample_page,
    "validate": sample_page,
}


def write_report(folder: str | Path) -> Path:
    """Rewrite report.html in the folder of a finished run, completely or not at all.

    Raises
    ------
    InputError
        If the folder has no results of a kind with a page (``PAGES``).
    """
    folder = Path(folder)
    files.require_files(folder, (), "map")
    files.recover(folder)
    manifest = files.read_manifest(folder)
    kind = manifest and manifest["kind"]
    if kind not in PAGES:
        wrong = f"'{folder}' has no results of map, sample or validate; give that of a finished run"
        raise InputError(wrong)
    path = folder / REPORT
    with files.replacing(path) as partial:
        partial.write_text(PAGES[kind](folder, folder.resolve().name), encoding="utf-8")
    return path
