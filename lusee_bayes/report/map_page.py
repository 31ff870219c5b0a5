"""The report of a map run, out of what it has left in its folder."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import xarray as xr

from lusee_bayes.core.files import require_files
from lusee_bayes.core.reading import entries, read_table
from lusee_bayes.judge.chi2 import probability
from lusee_bayes.judge.levels import LEVELS, NAMES
from lusee_bayes.report import html
from lusee_bayes.report.explorer import explorer
from lusee_bayes.report.sections import flight_section, map_unknowns
from lusee_bayes.results.finished_runs import FinishedRun
from lusee_bayes.results.saved import COVERAGE, DIAGNOSIS, POINTING, SOURCES

NEEDED = ("summary.json", "spectra.csv", "scenario.yaml", "diagnostics.nc", "mean.fits", "std.fits")
# what each figure shows, for those who cannot see it, and its caption
FIGURES = {
    "maps": (
        "Galactic maps: posterior mean and its standard deviation, and, where the true sky is "
        "known, truth and difference",
        "Posterior mean and standard deviation; truth and difference where the sky is known. "
        "All but the standard deviation are drawn through the Gaussian beam named above the "
        "maps, so that bright edges have no rings; files and numbers are without it.",
    ),
    "draws": (
        "Galactic maps of four draws of the posterior",
        "Draws of the posterior: skies that agree with the data and the prior. Features that "
        "all draws share are constrained; those that differ are not.",
    ),
    "fidelity": (
        "Curves over multipole ell: correlation with the truth and signal-to-noise where the "
        "truth is known, and the share of the variance that the prior supplies",
        "Correlation with the truth, signal-to-noise ratio, and the share of the prior.",
    ),
    "spectra": (
        "Power spectra of prior, posterior mean, posterior variance and truth",
        "Power spectra. Where the posterior variance reaches the prior, the data add no "
        "information.",
    ),
    "data_vector": (
        "The measured visibilities, product by product",
        "The data, product by product.",
    ),
    "residuals": (
        "Standardised residuals of every datum by product and time, and p-values by product",
        "Every datum against the prediction of all others, in standard deviations.",
    ),
    "beams": (
        "Beams of an auto and two crosses seen from above, North up",
        "Beams used for the map.",
    ),
}
# days in the table, the worst first
WORST_DAYS = 5


def map_page(folder: Path, name: str) -> str:
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
    require_files(folder, (*NEEDED, *(f"figures/{figure}.png" for figure in FIGURES)), "map")
    run = FinishedRun.read(folder)
    summary, found = run.summary, run.diagnostics
    frequency = f"{summary['frequency_mhz']:g} MHz"
    return html.run_page(
        folder,
        f"{name}: the sky at {frequency}",
        frequency,
        summary,
        [
            html.verdict(found.attrs["level"], found.attrs["verdict"]),
            *_mistakes(folder, summary),
            html.doubtful(folder / "summary.json", summary),
        ],
        {
            ("map", "The map"): _map(folder, summary, found),
            ("scales", "Scales"): _scales(folder, run),
            **flight_section(folder),
            ("data", "Data and prediction"): _data(folder, summary, found),
            ("numbers", "Numbers"): _numbers(folder, summary),
        },
    )


def _figure(folder: Path, name: str) -> str:
    return html.figure(folder, name, *FIGURES[name])


def _map(folder: Path, summary: dict, found: xr.Dataset) -> list[str]:
    hidden = summary["never_observed_fraction"]
    bands = None
    if summary.get("coverage") is not None:
        bands = entries(folder / "summary.json", summary, "coverage", COVERAGE)
    return [
        html.paragraph(
            f"{summary['prior'] or ''} {hidden:.1%} of the sky never rose above the horizon: there "
            "the map is the prior's. "
            "The share from the prior is that of a pixel's variance, the monopole left out."
        ),
        explorer(folder, found),
        _figure(folder, "maps"),
        _figure(folder, "draws"),
        *([] if bands is None else coverage_table(bands)),
    ]


def coverage_table(bands: list[dict]) -> list[str]:
    """How often error bars hold the truth, by band of latitude, as summary.json tells it."""
    header = ("", *(f"{level:.0%} intervals" for level in LEVELS), "rms pull", "largest")
    rows = [
        (
            str(row["name"]),
            *(f"{row[f'held_{n}']:.1%} ± {100 * row[f'scatter_{n}']:.1f}" for n in NAMES),
            f"{row['rms']:.2f} ± {row['rms_scatter']:.2f}",
            f"{row['largest']:.1f} ({row['allowed']:.1f})",
        )
        for row in bands
    ]
    return [
        html.subsection("Are the error bars right?"),
        html.paragraph(
            "Share of pixels whose true temperature lies within central intervals of four levels; "
            "the rms pull, (truth - mean) / standard deviation; the largest pull and, in brackets, "
            "what the largest pull of 95 % of skies does not exceed. ± is the scatter where error "
            "bars are right, of skies drawn from the posterior: neighbouring pixels err alike, so "
            "that a narrow band counts few independent ones."
        ),
        html.table(header, rows),
    ]


def _scales(folder: Path, run: FinishedRun) -> list[str]:
    cross, resolution = run.summary["ell_cross"], run.summary["effective_resolution_deg"]
    text = []
    if "snr" in run.spectra:
        text.append(
            "SNR_ell stays above 1 at every ell."
            if cross is None
            else f"SNR_ell falls below 1 first at ell = {cross}."
        )
    if resolution is None:
        text.append("The data supply more than the prior up to the highest ell.")
    else:
        text.append(
            f"The prior supplies more than half of the variance from ell = {180 / resolution:.0f} "
            f"on: a resolution of {resolution:.1f} degrees."
        )
    return [
        html.paragraph(" ".join(text)),
        _figure(folder, "fidelity"),
        _figure(folder, "spectra"),
        _by_ell(run),
    ]


def _by_ell(run: FinishedRun) -> str:
    """The columns of spectra.csv, a row for each multipole."""
    names = {
        "ell": "ell",
        "rho": "correlation",
        "snr": "SNR",
        "prior_fraction": "share of the prior",
        "cl_prior": "C prior [K²]",
        "cl_mean": "C mean [K²]",
        "cl_truth": "C truth [K²]",
        "cl_posterior_variance": "C variance [K²]",
    }
    here = [name for name in names if name in run.spectra]
    rows = [
        ["" if np.isnan(run.spectra[name][k]) else f"{run.spectra[name][k]:.4g}" for name in here]
        for k in range(len(run.spectra["ell"]))
    ]
    return html.folded("every multipole", html.table([names[name] for name in here], rows))


def _data(folder: Path, summary: dict, found: xr.Dataset) -> list[str]:
    kinds = found["group_kind"].values
    header = ("", "data", "chi² given all others", "expected", "p", "p of the others without it")
    parts = [
        html.paragraph(
            "Each product, day and turntable angle as a whole is compared with what all other data "
            "predict of it, whatever the prior: chi² counts what no sky explains, and directions "
            "of the sky that only this group has seen take a degree of freedom each. A bad group "
            "spoils the predictions of others too; the culprit is the group whose removal makes "
            "the rest fit (last column)."
        ),
        _figure(folder, "residuals"),
    ]
    marked = [
        str(x) for key in ("suspects", "extremes") for x in np.atleast_1d(found.attrs.get(key, ()))
    ]
    for kind, title, name in (
        ("product", "By product", "product"),
        ("day", "By day", "day"),
        ("angle", "By turntable angle", "turntable angle"),
    ):
        rows, note = np.flatnonzero(kinds == kind), ""
        if not len(rows):  # too many data whose noise couples times: the verdict says so
            continue
        if kind == "day" and len(rows) > WORST_DAYS:
            order = np.argsort(found["group_p"].values[rows])
            note = f" (the {WORST_DAYS} least probable of {len(rows)})"
            rows = rows[order[:WORST_DAYS]]
        cells = [_group_row(found, int(row)) for row in rows]
        bad = [f"{name} {cell[0]}" in marked for cell in cells]
        parts += [html.paragraph(f"{title}{note}"), html.table(header, cells, bad)]
    parts += _pointing(folder)
    parts += map_unknowns(folder, summary)
    parts.append(_figure(folder, "data_vector"))
    return parts


def _mistakes(folder: Path, summary: dict) -> list[str]:
    """The usual mistakes that would explain the data, where they were tried."""
    if summary.get("diagnosis") is None:
        return []
    found = entries(folder / "summary.json", summary, "diagnosis", DIAGNOSIS)
    cells = [
        (
            row["mistake"],
            row["remedy"],
            f"{row['chi2']:.4g}",
            f"{row['chi2_expected']:.0f}",
            probability(row["p"]).removeprefix("= "),
        )
        for row in found
    ]
    header = ("mistake", "what to do", "chi² without it", "expected", "p")
    text = (
        "Signs, exchanged products and ports, angles, clocks, factors, constants, noise level and "
        "lmax were tried one by one. "
    )
    if not cells:
        text += "None of them explains the data, or the data need none."
    elif not found[0]["fits"]:
        text += "None explains the data; the closest:"
    else:
        text += "Without one of these the data would fit, the best first:"
    parts = [html.subsection("Did you mean?"), html.paragraph(text)]
    return [*parts, *([html.table(header, cells)] if cells else [])]


def _pointing(folder: Path) -> list[str]:
    """Offsets of clock and pointing, and those that each day prefers, where the run has them."""
    parts = []
    if (folder / "pointing.csv").is_file():
        table = read_table(folder / "pointing.csv", POINTING)
        header = ("offset", "found", "+-", "+- before the data", "beyond first order [noise]")
        parts = [html.table(header, html.cells(table, POINTING, ("", ".4g", ".2g", ".2g", ".1g")))]
    if html.figure_path(folder, "pointing").is_file():
        parts.append(
            html.figure(
                folder,
                "pointing",
                "Preferred offsets of clock, turntable and lean, day by day",
                "The offset that each day would prefer if all others had none, and that of all "
                "days alike, in terms of which chi² falls most. Days that scatter about zero "
                "within their errors ask for none.",
            )
        )
    return [html.subsection("Clock and pointing"), *parts] if parts else []


def _group_row(found: xr.Dataset, row: int) -> tuple[str, ...]:
    others = float(found["group_others_p"].values[row])
    return (
        str(found["group_name"].values[row]),
        str(int(found["group_n"].values[row])),
        f"{float(found['group_chi2'].values[row]):.1f}",
        f"{float(found['group_degrees'].values[row]):.1f}",
        probability(float(found["group_p"].values[row])).removeprefix("= "),
        "no others" if np.isnan(others) else probability(others).removeprefix("= "),
    )


def _numbers(folder: Path, summary: dict) -> list[str]:
    rows = [
        ("ln evidence", f"{summary['log_evidence']:.2f}"),
        ("information about the sky", f"{summary['information_bits']:.0f} bits"),
        ("data", f"{summary['n_data']} ({summary['n_missing']} missing)"),
        ("modes", str(summary["n_modes"])),
        (
            "chi² of the residuals about the map",
            f"{summary['chi2']:.1f}, expected {summary['chi2_expected']:.1f}",
        ),
        ("last refinement of the mean", f"{summary['mean_refinement_sigma']:.1g} sigma"),
    ]
    if summary["beam_rms_difference"] is not None:
        off = f"{summary['beam_rms_difference']:.2%}"
        rows.append(("difference of true and modelled beams", off))
    parts = [html.table(("", ""), rows)]
    sources = folder / "sources.csv"
    if sources.is_file():
        table = read_table(sources, SOURCES)
        cells = html.cells(table, SOURCES, ("", "", ".4g", ".2g"))
        parts += [
            html.paragraph("Point sources beside the map"),
            html.table(("source", "block", "flux [Jy]", "+- [Jy]"), cells),
        ]
    parts.append(_figure(folder, "beams"))
    return parts
