"""The report of a comparison of priors, out of what it has left in its folder."""

from __future__ import annotations

from pathlib import Path

from lusee_bayes.core.errors import InputError
from lusee_bayes.core.files import require_files
from lusee_bayes.core.reading import entries, read_json
from lusee_bayes.report import head, html
from lusee_bayes.report.run_details import details
from lusee_bayes.results.prior_comparison import prior_table
from lusee_bayes.results.saved import COVERAGE, HELD_OUT, PRIOR, PRIORS, SKY_ERRORS, SNR

FIGURE = (
    "Differences of ln evidence and of the density of data left out, coverage by latitude and "
    "spectra of errors, for each prior",
    "How far each prior is below the best: bars, ln evidence by Laplace's approximation; squares "
    "and circles, ln p of products and days left out. Where the sky is known: the share of pixels "
    "that 68 % intervals hold, with "
    "its scatter if the posterior is right, and spectra of the errors.",
)
SECTIONS = [
    ("priors", "The priors"),
    ("files", "Files and citation"),
    ("run", "The run"),
]


def priors_page(folder: Path, name: str) -> str:
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
    require_files(folder, ("priors.json", "scenario.yaml", "figures/priors.png"), "compare-priors")
    path = folder / "priors.json"
    found = read_json(path, PRIORS)
    priors = _priors(path, found)
    notes = found.get("notes")
    if not isinstance(notes, list) or not all(isinstance(text, str) for text in notes):
        raise InputError(f"{path}: notes is no list of texts; make the results anew")
    frequency = f"{found['frequency_mhz']:g} MHz"
    words = [(str(one["name"]), str(one["prior"])) for one in priors]
    return html.page(
        f"{name}: one data set at {frequency} under several priors",
        [
            html.contents(SECTIONS),
            html.paragraph(found["verdict"], "verdict"),
            head.about(folder, frequency),
            html.section(
                *SECTIONS[0],
                *map(html.paragraph, notes),
                html.table(*prior_table(priors)),
                html.figure(folder / "figures" / "priors.png", *FIGURE),
                html.definitions(words),
            ),
            html.section(*SECTIONS[1], head.downloads(folder), head.citation(folder)),
            html.section(*SECTIONS[2], *details(folder, found)),
        ],
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
