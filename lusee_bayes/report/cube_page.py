"""The report of a run of several frequencies, out of what it has left in its folder."""

from __future__ import annotations

from pathlib import Path

from lusee_bayes.core.files import require_files
from lusee_bayes.core.reading import entries, read_json
from lusee_bayes.report import html
from lusee_bayes.report.run_details import details
from lusee_bayes.results.saved import CHANNEL_SUMMARY, CUBE_SUMMARY, JOINT_SUMMARY

NEEDED = ("summary.json", "spectra.csv", "scenario.yaml", "mean.fits", "std.fits")
FIGURES = {
    "maps": (
        "Galactic maps of posterior mean and standard deviation at several frequencies",
        "Posterior mean and standard deviation, from the lowest channel to the highest.",
    ),
    "spectra": (
        "Brightness temperature against frequency with error bars in four directions of the sky",
        "Spectra of four directions (pixels of the map) with one standard deviation.",
    ),
    "fidelity": (
        "Signal-to-noise ratio by multipole and frequency, and its mean over channels",
        "Signal-to-noise ratio by multipole and frequency where the truth is known, else the share "
        "of the variance that the prior supplies; right: mean over channels.",
    ),
    "chi2": (
        "Chi-squared of every channel over its expectation",
        "Residuals of every channel about its map; grey: two standard deviations of the widest "
        "distribution they can have if the model holds.",
    ),
}
SECTIONS = [
    ("maps", "The maps"),
    ("spectra", "Spectra"),
    ("scales", "Scales"),
    ("data", "Data and prediction"),
    ("run", "The run"),
]


def cube_page(folder: Path, name: str) -> str:
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
    summary = read_json(folder / "summary.json", CUBE_SUMMARY)
    channels = entries(folder / "summary.json", summary, "channels", CHANNEL_SUMMARY)
    frequencies = [channel["frequency_mhz"] for channel in channels]
    title = (
        f"{name}: the sky at {len(frequencies)} frequencies, "
        f"{frequencies[0]:g} to {frequencies[-1]:g} MHz"
    )
    fits = summary["verdict"].startswith("The data of all channels fit")
    anchors = dict(zip(("maps", "spectra", "fidelity", "chi2"), SECTIONS, strict=False))
    parts = {
        name: [html.figure(folder / "figures" / f"{name}.png", *texts)]
        for name, texts in FIGURES.items()
    }
    joint = None
    if summary.get("joint") is not None:
        (joint,) = entries(
            folder / "summary.json", {"joint": [summary["joint"]]}, "joint", JOINT_SUMMARY
        )
    parts["maps"].append(html.paragraph(_how(joint, summary.get("log_evidence"))))
    parts["chi2"].append(_table(channels))
    return html.page(
        title,
        [
            html.contents(SECTIONS),
            html.paragraph(summary["verdict"], "verdict" if fits else "verdict bad"),
            *(html.section(*anchors[name], *inside) for name, inside in parts.items()),
            html.section(*SECTIONS[-1], *details(folder, summary)),
        ],
    )


def _how(joint: dict | None, evidence: float | None) -> str:
    known = "" if evidence is None else f" ln evidence {evidence:.1f}."
    if joint is None:
        return f"Every channel has a posterior of its own.{known}"
    solver = joint["solver"]
    if joint["iterations"]:
        solver += f" ({joint['iterations']} iterations)"
    names = ", ".join(name.replace("_", " ") for name in joint["components"])
    return (
        f"All channels share one posterior; component maps: {names}. Solved by {solver}, last step "
        f"{joint['refinement_sigma']:.1g} sigma.{known}"
    )


def _table(channels: list[dict]) -> str:
    header = ("MHz", "data", "missing", "chi²", "expected", "first ell with SNR < 1")
    rows = [
        (
            f"{c['frequency_mhz']:g}",
            c["n_data"],
            c["n_missing"],
            f"{c['chi2']:.0f}",
            f"{c['chi2_expected']:.0f}" if "chi2_expected" in c else "unknown",
            "" if c.get("ell_cross") is None else c["ell_cross"],
        )
        for c in channels
    ]
    return html.folded("every channel", html.table(header, rows))
