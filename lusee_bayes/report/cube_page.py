"""The report of a run of several frequencies, out of what it has left in its folder."""

from __future__ import annotations

from pathlib import Path

from lusee_bayes.core.checks import counted
from lusee_bayes.core.files import require_files
from lusee_bayes.core.reading import entries, read_json
from lusee_bayes.judge.chi2 import stands_out
from lusee_bayes.judge.cube_fit import N_TESTS
from lusee_bayes.report import html
from lusee_bayes.report.explorer import cube_explorer
from lusee_bayes.report.sections import cube_unknowns, flight_section
from lusee_bayes.results.saved import (
    CHANNEL_SUMMARY,
    COVERAGE,
    CUBE_SUMMARY,
    JOINT_SUMMARY,
    JOINT_TEST,
    PULLS,
)

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
        "What no sky explains of every channel's data: chi² over its expectation, whatever the "
        "prior; grey: two standard deviations.",
    ),
}


def cube_page(folder: Path, name: str) -> str:
    """The page as text, of the folder and the name of a run. InputError as :func:`.map_page`."""
    require_files(folder, (*NEEDED, *(f"figures/{figure}.png" for figure in FIGURES)), "map")
    where = folder / "summary.json"
    summary = read_json(where, CUBE_SUMMARY)
    channels = entries(where, summary, "channels", CHANNEL_SUMMARY)
    frequencies = [channel["frequency_mhz"] for channel in channels]
    band = f"{frequencies[0]:g} to {frequencies[-1]:g} MHz"
    count = len(channels)
    figures = {name: html.figure(folder, name, *texts) for name, texts in FIGURES.items()}
    maps = [
        cube_explorer(folder, frequencies),
        figures["maps"],
        html.paragraph(_how(where, summary)),
    ]
    if "coverage" in channels[0]:
        maps.append(_coverage(where, channels))
    unmapped = html.sentences(where, summary, "unmapped")
    return html.run_page(
        folder,
        f"{name}: the sky at {counted(count, 'frequency', 'frequencies')}, {band}",
        f"{counted(count, 'channel')}, {band}",
        summary,
        [
            html.verdict(summary["level"], summary["verdict"]),
            html.doubtful(where, summary),
            "\n".join(html.paragraph(text, html.BAD) for text in unmapped),
        ],
        {
            ("maps", "The maps"): maps,
            ("spectra", "Spectra"): [figures["spectra"], *_pulls(where, summary)],
            ("scales", "Scales"): [figures["fidelity"]],
            ("data", "Data and prediction"): [
                _tests(where, summary),
                figures["chi2"],
                _table(channels),
                *cube_unknowns(folder, summary),
            ],
            **flight_section(folder),
        },
    )


def _how(where: Path, summary: dict) -> str:
    known = f" ln evidence {summary['log_evidence']:.1f}."
    if summary.get("joint") is None:
        tied = ", given what the others tell of its receivers" * summary.get("tied", False)
        return f"Every channel has a posterior of its own{tied}.{known}"
    (joint,) = entries(where, {"joint": [summary["joint"]]}, "joint", JOINT_SUMMARY)
    solver = joint["solver"]
    if joint["iterations"]:
        solver += f" ({joint['iterations']} iterations)"
    names = ", ".join(name.replace("_", " ") for name in joint["components"])
    # runs of older versions do not say it
    prior = f" {joint['prior']}" if joint.get("prior") else ""
    return (
        f"All channels share one posterior; component maps: {names}. Solved by {solver}, last step "
        f"{joint['refinement_sigma']:.1g} sigma.{known}{prior}"
    )


def _tests(where: Path, summary: dict) -> str:
    tests = entries(where, summary, "tests", JOINT_TEST)
    rows = [
        (t["test"], t["found"], f"{t['p']:.2g}", "" if t["among"] == 1 else t["among"], t["level"])
        for t in tests
    ]
    bad = [t["level"] != "consistent" for t in tests]
    note = html.paragraph(
        "All channels together: what no sky explains, whatever the prior, and what the prior does "
        "not expect. A small excess that no channel shows by itself is seen in the sum and in the "
        "number of channels above the median."
    )
    return note + html.table(("joint test", "found", "p", "smallest of", "verdict"), rows, bad)


def _pulls(where: Path, summary: dict) -> list[str]:
    """How far the spectra are from the truth, and why in the plane."""
    if not summary.get("pulls"):
        return []
    found = entries(where, summary, "pulls", PULLS)
    rows = [
        (p["direction"], f"{p['rms']:.2f}", f"{p['worst']:+.1f} at {p['worst_mhz']:g} MHz")
        for p in found
    ]
    return [
        html.paragraph(
            "Difference of mean and truth in standard deviations. A spectrum is that of one "
            "direction as the map resolves it: the mean is the true sky averaged with the "
            "point-spread function, and the prior fills in what is smaller. Towards the Galactic "
            "centre ionised gas absorbs a lane of a few degrees within bright rims, the deeper the "
            "lower the frequency. A map that is coarser than the lane averages lane and rims, and "
            "its mean is brighter than the truth in the lane. The standard deviation does not "
            "tell: the isotropic Gaussian prior does not expect so much structure within a few "
            "degrees. Away from the plane mean and truth agree within the error bars."
        ),
        html.table(("direction", "rms over channels", "furthest"), rows),
    ]


def _coverage(where: Path, channels: list[dict]) -> str:
    """Share of pixels whose 68 % interval holds the truth, a row for each channel."""
    bands = [entries(where, channel, "coverage", COVERAGE) for channel in channels]
    header = ("MHz", *(band["name"] for band in bands[0]))
    rows = [
        (f"{c['frequency_mhz']:g}", *(f"{band['held_68']:.1%}" for band in mine))
        for c, mine in zip(channels, bands, strict=True)
    ]
    scatter = ", ".join(f"{100 * band['scatter_68']:.1f}" for band in bands[0])
    note = html.paragraph(
        "Share of pixels whose 68 % interval holds the true temperature. Where error bars are "
        f"right, it scatters by {scatter} % in the columns (lowest channel)."
    )
    return html.folded(
        "are the error bars right? coverage by latitude", note, html.table(header, rows)
    )


def _table(channels: list[dict]) -> str:
    header = (
        "MHz",
        "data",
        "missing",
        "p of the instrument",
        "chi² about the map",
        "expected",
        "first ell, SNR < 1",
    )
    rows = [
        (
            f"{c['frequency_mhz']:g}",
            c["n_data"],
            c["n_missing"],
            f"{c['instrument_p']:.2g}",
            f"{c['chi2']:.0f}",
            f"{c['chi2_expected']:.0f}",
            "" if c.get("ell_cross") is None else c["ell_cross"],
        )
        for c in channels
    ]
    bad = [stands_out(c["instrument_p"], N_TESTS * len(channels)) for c in channels]
    return html.folded("every channel", html.table(header, rows, bad))
