"""The page that sets finished runs side by side."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from lusee_bayes.linear.fit import RULE
from lusee_bayes.report import html
from lusee_bayes.results.finished_runs import FinishedRun, comparison_rows, evidence_caveat
from lusee_bayes.results.provenance import Provenance

HEADER = {
    "run": "run",
    "level": "fit",
    "frequency_mhz": "MHz",
    "n_data": "data",
    "ell_cross": "SNR < 1 from ell",
    "effective_resolution_deg": "resolution [°]",
    "information_bits": "bits",
    "log_evidence": "ln evidence",
    "log_evidence_less_best": "less the best",
    "instrument_p": "p of the instrument",
    "prior_p": "p of the prior",
    "mean_std_k": "mean standard deviation [K]",
}


def comparison_page(runs: Sequence[FinishedRun], figures: Path) -> str:
    """The page as text; ``figures``: folder with maps.png and curves.png."""
    rows = [
        [_shown((row | {"ell_cross": run.cross_in_words()})[key]) for key in HEADER]
        for run, row in zip(runs, comparison_rows(runs), strict=True)
    ]
    caveat = evidence_caveat(runs)
    same = "All runs map the same data: differences of ln evidence say which model they prefer."
    names = ", ".join(run.name for run in runs)
    return html.page(
        f"Side by side: {names}",
        [
            html.paragraph(caveat or same, "verdict" if caveat is None else "verdict tense"),
            html.paragraph(f"{RULE}.", "threshold"),
            html.table(list(HEADER.values()), rows),
            html.subsection("Where they come from"),
            html.table(("run", "data", "dates, UTC", "command", "made"), origins(runs)),
            html.figure(
                figures / "curves.png",
                "Correlation with the truth, signal-to-noise and share of the prior over "
                "multipole ell, a line for each run",
                "Fidelity and the share of the prior.",
            ),
            html.figure(
                figures / "maps.png",
                "Galactic maps of posterior mean and standard deviation, a row for each run",
                "Posterior means, and standard deviations, on one scale each.",
            ),
        ],
    )


def origins(runs: Sequence[FinishedRun]) -> list[tuple[str, ...]]:
    """Name, data, dates, command, date and version of every run, a row each."""
    return [_origin(run.name, run.provenance) for run in runs]


def _origin(name: str, found: Provenance | None) -> tuple[str, ...]:
    if found is None:
        return name, "not recorded", "-", "-", "by an earlier version"
    dates = f"{found.first} to {found.last}"
    command = found.command or "a call of the library"
    return name, found.data_line(), dates, command, f"{found.made} by lusee_bayes {found.version}"


def _shown(value: object) -> str:
    if value is None:
        return "-"
    return f"{value:.4g}" if isinstance(value, float) else str(value)
