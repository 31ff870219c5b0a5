"""The report of a sampled run, or of a validation, out of what it has left in its folder."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from lusee_bayes.core.files import require_files
from lusee_bayes.core.reading import entries, read_json, read_table
from lusee_bayes.judge.convergence import CRITERIA, FAR, FEW, warnings_of
from lusee_bayes.report import html
from lusee_bayes.results.saved import CHECK, SAMPLING, SUMMARY_TABLE, VALIDATION

# name, text for those who do not see it, caption
FIGURES = {
    "uncertainty": (
        "Galactic maps of the draws: mean, standard deviation, width and asymmetry of intervals",
        "Mean, standard deviation and intervals of the draws.",
    ),
    "traces": (
        "Draws of each quantity over time for every chain, with histograms",
        "Draws over time: all chains should look like the same noise.",
    ),
    "ranks": (
        "Difference of the distribution of ranks from a uniform one, a curve for each chain",
        "Ranks of each chain's draws among all: the curves stay within the grey band if the chains "
        "agree.",
    ),
    "energy": (
        "BFMI of each chain, and densities of the energy of the draws and of its changes",
        "Energies and their changes from draw to draw: where changes are much narrower, chains "
        "move slowly.",
    ),
    "pairs": (
        "Draws of pairs of quantities against each other",
        "Pairs of quantities: what cannot be sampling apart lies along lines.",
    ),
    "against_analytic": (
        "Means and standard deviations of the draws against the analytic posterior, mode by mode",
        "The draws against the analytic posterior of the scenario with its marginalised terms: "
        "equal for a Gaussian program, and different where sampling matters.",
    ),
    "comparison": (
        "HMC against the analytic posterior: means, variances, covariance, effective sizes",
        "HMC against the analytic posterior.",
    ),
    "calibration": (
        "Rank histograms over simulated data sets and coverage of intervals",
        "Calibration over simulated data sets.",
    ),
}


def sample_page(folder: Path, name: str) -> str:
    """The page as text, of the folder and the name of a run. InputError as :func:`.map_page`."""
    require_files(folder, ("summary.csv", "sampling.json", "scenario.yaml"), "sample")
    sampling = read_json(folder / "sampling.json", SAMPLING)
    table = read_table(folder / "summary.csv", SUMMARY_TABLE)
    header, rows = list(table), list(zip(*table.values(), strict=True))
    worst = float(np.nanmax(table["r_hat"], initial=-np.inf))
    agreement = f"R-hat at most {worst:.4f}" if np.isfinite(worst) else "too few draws for R-hat"
    verdict = (
        f"{sampling['chains']} x {sampling['draws']} draws of {sampling['program']}: {agreement}, "
        f"{sampling['divergences']} divergences, mean acceptance "
        f"{sampling['mean_acceptance']:.2f}."
    )
    reasons = warnings_of(table, sampling)
    kind = html.TENSE if reasons else html.GOOD
    if worst > FAR or sampling["divergences"] > FEW * sampling["chains"] * sampling["draws"]:
        kind = html.BAD
    sections = {("summary", "Summary"): [html.table(header, map(_short, rows))]}
    validation = folder / "validation.json"
    if validation.is_file():
        checks = entries(validation, read_json(validation, VALIDATION), "checks", CHECK)
        sections["checks", "Checks"] = [_checks(checks)]
    sections["pictures", "Pictures"] = [
        html.figure(folder, figure, *texts)
        for figure, texts in FIGURES.items()
        if html.figure_path(folder, figure).is_file()
    ]
    return html.run_page(
        folder,
        f"{name}: draws of {sampling['program']}",
        f"draws of the program {sampling['program']}",
        sampling,
        [
            html.paragraph(" ".join([*reasons[:1], verdict, *reasons[1:]]), kind),
            html.paragraph(CRITERIA, "threshold"),
            html.doubtful(folder / "sampling.json", sampling),
        ],
        sections,
    )


def _checks(checks: list[dict]) -> str:
    rows, bad = [], []
    for check in checks:
        bounds = [check.get("lower"), check.get("upper")]
        allowed = " to ".join("any" if b is None else f"{b:.4g}" for b in bounds)
        verdict = "ok" if check["passed"] else "failed"
        rows.append((check["name"], f"{check['value']:.4g}", allowed, verdict, check["meaning"]))
        bad.append(not check["passed"])
    return html.table(("check", "value", "allowed", "", "what it is"), rows, bad)


def _short(row: tuple[object, ...]) -> list[str]:
    """Numbers of a row to five digits; what too few draws cannot tell is left out."""
    return [str(row[0]), *("" if np.isnan(cell) else f"{cell:.5g}" for cell in row[1:])]
