"""What every page begins and ends with: the verdict, where the data come from, files, citation."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from lusee_bayes.core.errors import InputError
from lusee_bayes.core.reading import read_text
from lusee_bayes.core.version import __version__
from lusee_bayes.linear.fit import LEVELS, RULE
from lusee_bayes.report import html
from lusee_bayes.results.map_files import text_hash
from lusee_bayes.results.provenance import Provenance

# files of a run that are worth a link, with what is in them
FILES = {
    "mean.fits": "posterior mean, HEALPix, K",
    "std.fits": "standard deviation, HEALPix, K",
    "lower.fits": "lower end of the 90 % interval, HEALPix, K",
    "upper.fits": "upper end of the 90 % interval, HEALPix, K",
    "truth.fits": "the true sky, HEALPix, K",
    "residual.fits": "mean less truth, HEALPix, K",
    "mean_alm.fits": "harmonic coefficients of the mean, as healpy.write_alm",
    "posterior.nc": "posterior over the modes; draws and covariance if asked for",
    "diagnostics.nc": "residuals, groups, point-spread functions",
    "samples.nc": "draws of all chains, ArviZ DataTree",
    "reduced.nc": "the spectra behind the map, reduced to bands and bins of time, with flags",
    "spectra.csv": "fidelity and power, a row for each multipole",
    "sources.csv": "fluxes of point sources",
    "pointing.csv": "offsets of clock and pointing",
    "unknowns.csv": "receivers, ground and gain table",
    "pointing_by_day.csv": "offsets that all days, and each day, would prefer",
    "summary.csv": "ArviZ's summary of the draws",
    "priors.json": "all that is told of every prior, and the verdict",
    "priors.csv": "the same, a row for each prior",
    "priors.md": "the same as a table to read",
    "validation.json": "the checks and their thresholds",
    "summary.json": "the figures of this page",
    "sampling.json": "the figures of this page",
    "scenario.yaml": "the resolved scenario: running it again gives the same numbers",
    "provenance.json": "where the data come from, command, version, date",
}
# how verdicts look
GOOD, TENSE, BAD = "verdict", "verdict tense", "verdict bad"
CLASSES = dict(zip(LEVELS, (GOOD, TENSE, BAD), strict=True))


def verdict(level: str, text: str) -> str:
    """The verdict on a fit, with the rule behind it."""
    rule = html.paragraph(f"{RULE}.", "threshold")
    return f"{html.paragraph(text, CLASSES[level])}\n{rule}"


def sentences(path: Path, found: Mapping[str, Any], name: str) -> list[str]:
    """Sentences of a run's figures; none if they do not have them.

    Raises
    ------
    InputError
        If it is no list of texts.
    """
    told = found.get(name, [])
    if not isinstance(told, list) or not all(isinstance(text, str) for text in told):
        raise InputError(f"{path}: {name} is no list of texts; make the results anew")
    return told


def doubts(path: Path, found: Mapping[str, Any]) -> str:
    """What is doubtful about the data, as a run's figures tell it; nothing if they do not.

    Raises
    ------
    InputError
        If it is no list of sentences.
    """
    told = sentences(path, found, "doubts")
    return "\n".join(html.paragraph(f"Doubtful: {text}", TENSE) for text in told)


def unmapped(path: Path, found: Mapping[str, Any]) -> str:
    """Which channels could not be mapped, and why; nothing if a run's figures name none.

    Raises
    ------
    InputError
        If it is no list of sentences.
    """
    return "\n".join(html.paragraph(t, BAD) for t in sentences(path, found, "unmapped"))


def about(folder: Path, channels: str) -> str:
    """Where the results come from; ``channels``: the frequencies in words."""
    found = Provenance.read(folder)
    if found is None:
        return html.paragraph(
            f"{channels}. Data, command and date were not recorded: the folder is of an earlier "
            "version."
        )
    site = f"longitude {found.lon_deg:g}°, latitude {found.lat_deg:g}° (selenographic)"
    hours = found.step_s / 3600.0
    return html.definitions(
        [
            ("data", found.data_line()),
            ("site", site),
            (
                "dates",
                f"{found.first} to {found.last} UTC, {found.n_times} times of {hours:g} h",
            ),
            ("sky", f"{channels}, multipoles up to ell = {found.lmax}"),
            ("command", found.command or "a call of the library"),
            ("made", f"{found.made} UTC by lusee_bayes {found.version}"),
        ]
    )


def downloads(folder: Path) -> str:
    """Links to the files that lie beside the page."""
    there = [(name, text) for name, text in FILES.items() if (folder / name).is_file()]
    rows = [
        (html.link(name), text, f"{(folder / name).stat().st_size / 1e6:.2g} MB")
        for name, text in there
    ]
    note = "The links lead to the files beside this page; move them together."
    return f"{html.paragraph(note)}\n{html.table(('file', 'content', 'size'), rows)}"


def citation(folder: Path) -> str:
    """How to cite a result of this page."""
    found = Provenance.read(folder)
    version = __version__ if found is None else found.version
    made = "" if found is None else f", made {found.made[:10]}"
    scenario = text_hash(read_text(folder / "scenario.yaml", "a scenario"))[:12]
    return "\n".join(
        [
            html.paragraph(
                "Cite the software with its version and the hash of the scenario, which names "
                "every setting; the method is that of the reference paper (arXiv:2508.16773)."
            ),
            html.preformatted(
                f"lusee_bayes, version {version}: Bayesian maps of the low-frequency sky from "
                f"LuSEE-Night.\nScenario {scenario}{made}."
            ),
        ]
    )
