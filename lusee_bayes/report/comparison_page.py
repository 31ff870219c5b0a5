"""Pages that set finished runs, or priors for one data set, side by side."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from lusee_bayes.core.errors import InputError
from lusee_bayes.core.files import require_files
from lusee_bayes.core.reading import entries, read_json
from lusee_bayes.judge.chi2 import RULE
from lusee_bayes.report import html
from lusee_bayes.results.finished_runs import (
    FinishedRun,
    comparison_rows,
    evidence_caveat,
)
from lusee_bayes.results.prior_comparison import prior_table
from lusee_bayes.results.saved import COVERAGE, HELD_OUT, PRIOR, PRIORS, SKY_ERRORS, SNR

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


def comparison_page(runs: Sequence[FinishedRun], folder: Path) -> str:
    """The page as text; ``folder`` has the figures maps and curves."""
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
            html.table(("run", "data", "dates, UTC", "command", "made"), map(_origin, runs)),
            html.figure(
                folder,
                "curves",
                "Correlation with the truth, signal-to-noise and share of the prior over "
                "multipole ell, a line for each run",
                "Fidelity and the share of the prior.",
            ),
            html.figure(
                folder,
                "maps",
                "Galactic maps of posterior mean and standard deviation, a row for each run",
                "Posterior means, and standard deviations, on one scale each.",
            ),
        ],
    )


def _origin(run: FinishedRun) -> tuple[str, ...]:
    """Name, data, dates, command, date and version of a run."""
    found = run.provenance
    if found is None:
        return run.name, "not recorded", "-", "-", "by an earlier version"
    dates = f"{found.first} to {found.last}"
    command = found.command or "a call of the library"
    made = f"{found.made} by lusee_bayes {found.version}"
    return run.name, found.data_line(), dates, command, made


def _shown(value: object) -> str:
    if value is None:
        return "-"
    return f"{value:.4g}" if isinstance(value, float) else str(value)


FIGURE = (
    "Differences of ln evidence and of the density of data left out, coverage by latitude and "
    "spectra of errors, for each prior",
    "How far each prior is below the best: bars, ln evidence by Laplace's approximation; squares "
    "and circles, ln p of products and days left out. Where the sky is known: the share of pixels "
    "that 68 % intervals hold, with "
    "its scatter if the posterior is right, and spectra of the errors.",
)


def priors_page(folder: Path, name: str) -> str:
    """The page as text, of the folder and the name of a run. InputError as :func:`.map_page`."""
    require_files(folder, ("priors.json", "scenario.yaml", "figures/priors.png"), "compare-priors")
    path = folder / "priors.json"
    found = read_json(path, PRIORS)
    priors = _priors(path, found)
    notes = html.sentences(path, {"notes": None} | found, "notes")
    frequency = f"{found['frequency_mhz']:g} MHz"
    words = [(str(one["name"]), str(one["prior"])) for one in priors]
    told = [
        *map(html.paragraph, notes),
        html.table(*prior_table(priors)),
        html.figure(folder, "priors", *FIGURE),
        html.definitions(words),
    ]
    return html.run_page(
        folder,
        f"{name}: one data set at {frequency} under several priors",
        frequency,
        found,
        [html.paragraph(found["verdict"], "verdict")],
        {("priors", "The priors"): told},
    )


def _priors(path: Path, found: dict) -> list[dict]:
    """The entries, checked as deep as the table reads them."""
    priors = entries(path, found, "priors", PRIOR)
    if not priors:
        raise InputError(f"{path} has no prior; make the results anew")
    lengths = set()
    for one in priors:
        held = entries(path, one, "held_out", HELD_OUT)
        known = one.get("coverage") is not None
        parts = entries(path, one, "coverage", COVERAGE) if known else []
        errors = entries(path, one, "errors", SKY_ERRORS) if known else []
        snr = entries(path, one, "snr", SNR)
        lengths.add(tuple(map(len, (held, parts, errors, snr))))
    if len(lengths) > 1:
        raise InputError(f"{path}: its priors tell different things; make the results anew")
    return priors
