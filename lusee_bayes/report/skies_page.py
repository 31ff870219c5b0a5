"""The report of a validation on given skies, out of what it has left in its folder."""

from __future__ import annotations

from pathlib import Path

from lusee_bayes.core.files import require_files
from lusee_bayes.core.reading import entries, read_json
from lusee_bayes.report import head, html
from lusee_bayes.report.coverage_table import COVERAGE_HEADER, coverage_cells
from lusee_bayes.report.run_details import details
from lusee_bayes.results.saved import COVERAGE, SKIES, SKY, SKY_ERRORS

FIGURES = {
    "coverage": (
        "For each sky and band of Galactic latitude, the share of pixels that intervals of four "
        "levels hold, less the level, with its expected scatter",
        "Share of pixels whose truth an interval holds, less the level of the interval. Grey: its "
        "scatter, and twice that, if the posterior is right. Above zero error bars are too wide, "
        "below too narrow.",
    ),
    "pulls": (
        "Galactic maps of truth minus mean over standard deviation, one for each sky",
        "Where the truth is beyond the error bars. Dashed: never above the horizon.",
    ),
}
SECTIONS = [
    ("skies", "The skies"),
    ("coverage", "Coverage"),
    ("files", "Files and citation"),
    ("run", "The run"),
]


def skies_page(folder: Path, name: str) -> str:
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
    figures = (f"figures/{figure}.png" for figure in FIGURES)
    require_files(folder, ("coverage.json", "scenario.yaml", *figures), "validate --skies")
    path = folder / "coverage.json"
    found = read_json(path, SKIES)
    skies = entries(path, found, "skies", SKY)
    frequency = f"{found['frequency_mhz']:g} MHz"
    kind = head.GOOD if found["passed"] else head.BAD
    pictures = {
        key: html.figure(folder / "figures" / f"{key}.png", *texts)
        for key, texts in FIGURES.items()
    }
    return html.page(
        f"{name}: error bars on given skies at {frequency}",
        [
            html.contents(SECTIONS),
            html.paragraph(found["verdict"], kind),
            html.paragraph(found["thresholds"], "threshold"),
            head.about(folder, frequency),
            html.section(*SECTIONS[0], *_skies(path, skies), pictures["pulls"]),
            html.section(*SECTIONS[1], pictures["coverage"], *_coverage(path, skies)),
            html.section(*SECTIONS[2], head.downloads(folder), head.citation(folder)),
            html.section(*SECTIONS[3], *details(folder, found)),
        ],
    )


def _skies(path: Path, skies: list[dict]) -> list[str]:
    header = ("sky", "ln evidence", "chi²", "fit", "rms error [K]", "std / sky, by latitude", "SNR")
    rows = []
    for sky in skies:
        errors = entries(path, sky, "errors", SKY_ERRORS)
        rows.append(
            (
                sky["name"],
                f"{sky['log_evidence']:.1f}",
                f"{sky['chi2_model']:.0f} of {sky['n_data']}",
                sky["level"],
                f"{errors[-1]['rms_error_k']:.4g}",
                ", ".join(f"{band['std_over_sky']:.2f}" for band in errors[:-1]),
                ", ".join(f"{value:.1f} at {ell}" for ell, value in sky["snr"].items()),
            )
        )
    return [
        html.paragraph(
            "Data of each sky are simulated with the scenario's instrument and noise and mapped "
            "with the scenario's prior, which knows nothing of the sky."
        ),
        *(html.paragraph(f"{sky['sentence']}.") for sky in skies),
        html.table(header, rows, [not sky["passed"] for sky in skies]),
    ]


def _coverage(path: Path, skies: list[dict]) -> list[str]:
    parts = [
        html.paragraph(
            "Share of pixels, or of harmonic coefficients, whose truth lies within central "
            "intervals; rms of the pulls (truth - mean) / standard deviation; the largest pull "
            "and, in brackets, what that of 95 % of draws does not exceed. ± is the scatter if "
            "the posterior is right, counted over its draws."
        )
    ]
    for sky in skies:
        rows = map(coverage_cells, entries(path, sky, "coverage", COVERAGE))
        parts.append(html.folded(sky["name"], html.table(COVERAGE_HEADER, rows)))
    return parts
