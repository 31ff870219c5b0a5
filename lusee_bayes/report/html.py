"""HTML of reports: elements of a page, and what the pages of all runs have.

A page is one file with everything inside. That of a run begins with its verdict and where the data
come from, and ends with links to its files, how to cite it, and how it was made: scenario,
versions, times, memory.
"""

from __future__ import annotations

import base64
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from importlib import resources
from pathlib import Path
from typing import Any
from urllib.parse import quote

from lusee_bayes.core.errors import InputError
from lusee_bayes.core.layouts import Layout
from lusee_bayes.core.reading import read_text
from lusee_bayes.core.version import __version__, printable
from lusee_bayes.judge.chi2 import LEVELS, RULE
from lusee_bayes.results.finished_runs import Provenance
from lusee_bayes.results.map_files import text_hash


def page(title: str, parts: Iterable[str]) -> str:
    """A whole document that needs nothing but itself.

    Bytes of file names that are no UTF-8 are shown by their escapes.
    """
    style = package_text("report.css")
    body = "\n".join(parts)
    text = package_text("page.html").format(title=escape(title), style=style, body=body)
    return printable(text)


def package_text(name: str) -> str:
    """A file that lies beside this module."""
    return (resources.files("lusee_bayes.report") / name).read_text(encoding="utf-8")


def section(anchor: str, title: str, parts: Iterable[str]) -> str:
    """A part of the page with its heading."""
    inside = "\n".join([f"<h2>{escape(title)}</h2>", *parts])
    return f'<section id="{anchor}">\n{inside}\n</section>'


def subsection(title: str) -> str:
    """A heading within a section."""
    return f"<h3>{escape(title)}</h3>"


def paragraph(text: str, kind: str = "") -> str:
    """Plain text."""
    return f'<p class="{kind}">{escape(text)}</p>' if kind else f"<p>{escape(text)}</p>"


class Markup(str):
    """Text that is HTML already."""

    __slots__ = ()


def link(path: str) -> Markup:
    """A link to a file beside the page."""
    return Markup(f'<a href="{escape(quote(path))}" download>{escape(path)}</a>')


def definitions(rows: Iterable[tuple[str, str]]) -> str:
    """Names and what they mean, side by side."""
    inside = "".join(f"<dt>{escape(name)}</dt><dd>{escape(text)}</dd>" for name, text in rows)
    return f'<dl class="about">{inside}</dl>'


def figure(folder: Path, name: str, alternative: str, caption: str) -> str:
    """A picture of a run, inside the page, with a text for those who do not see it."""
    data = base64.b64encode(figure_path(folder, name).read_bytes()).decode()
    return (
        f'<figure><div class="scroll"><img src="data:image/png;base64,{data}" '
        f'alt="{escape(alternative)}"></div><p class="cue">Swipe the figure sideways.</p>'
        f"<figcaption>{escape(caption)}</figcaption></figure>"
    )


def figure_path(folder: Path, name: str) -> Path:
    """Where a run has a picture."""
    return folder / "figures" / f"{name}.png"


def table(
    header: Sequence[str], rows: Iterable[Sequence[object]], bad: Sequence[bool] | None = None
) -> str:
    """A table; rows that are ``bad`` stand out."""
    rows = list(rows)
    marks = bad if bad is not None else [False] * len(rows)
    head = "".join(f'<th scope="col">{escape(str(cell))}</th>' for cell in header)
    lines = [
        f"<tr{' class=bad' if mark else ''}>"
        + "".join(
            f"<td>{cell if isinstance(cell, Markup) else escape(str(cell))}</td>" for cell in row
        )
        + "</tr>"
        for row, mark in zip(rows, marks, strict=True)
    ]
    return (
        f'<div class="scroll"><table><thead><tr>{head}</tr></thead>\n<tbody>\n'
        + "\n".join(lines)
        + "\n</tbody></table></div>"
    )


def cells(
    table: Mapping[str, Iterable[object]], layout: Layout, forms: Sequence[str]
) -> list[tuple[str, ...]]:
    """The rows of a table that was read, each column in its form."""
    rows = zip(*(table[name] for name in layout.variables), strict=True)
    return [tuple(map(format, row, forms)) for row in rows]


def preformatted(text: str) -> str:
    """Text as it is, letter by letter."""
    return f"<pre>{escape(text)}</pre>"


def folded(summary: str, *parts: str) -> str:
    """What is seen when it is asked for."""
    return f"<details><summary>{escape(summary)}</summary>\n" + "\n".join(parts) + "\n</details>"


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
    rule = paragraph(f"{RULE}.", "threshold")
    return f"{paragraph(text, CLASSES[level])}\n{rule}"


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


def doubtful(path: Path, found: Mapping[str, Any]) -> str:
    """What is doubtful about the data, as a run's figures tell it.

    InputError as :func:`sentences`.
    """
    told = sentences(path, found, "doubts")
    return "\n".join(paragraph(f"Doubtful: {text}", TENSE) for text in told)


def provenance(folder: Path, channels: str) -> str:
    """Where the results come from; ``channels``: the frequencies in words."""
    found = Provenance.read(folder)
    if found is None:
        return paragraph(
            f"{channels}. Data, command and date were not recorded: the folder is of an earlier "
            "version."
        )
    site = f"longitude {found.lon_deg:g}°, latitude {found.lat_deg:g}° (selenographic)"
    hours = found.step_s / 3600.0
    return definitions(
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
        (link(name), text, f"{(folder / name).stat().st_size / 1e6:.2g} MB") for name, text in there
    ]
    note = "The links lead to the files beside this page; move them together."
    return f"{paragraph(note)}\n{table(('file', 'content', 'size'), rows)}"


def citation(folder: Path) -> str:
    """How to cite a result of this page."""
    found = Provenance.read(folder)
    version = __version__ if found is None else found.version
    made = "" if found is None else f", made {found.made[:10]}"
    scenario = text_hash(read_text(folder / "scenario.yaml", "a scenario"))[:12]
    return "\n".join(
        [
            paragraph(
                "Cite the software with its version and the hash of the scenario, which names "
                "every setting; the method is that of the reference paper (arXiv:2508.16773)."
            ),
            preformatted(
                f"lusee_bayes, version {version}: Bayesian maps of the low-frequency sky from "
                f"LuSEE-Night.\nScenario {scenario}{made}."
            ),
        ]
    )


def run_page(
    folder: Path,
    title: str,
    channels: str,
    figures: Mapping[str, Any],
    head: Sequence[str],
    sections: Mapping[tuple[str, str], Iterable[str]],
) -> str:
    """The page of a run.

    Parameters
    ----------
    folder : Path
        With the files of the run.
    title : str
    channels : str
        The frequencies in words.
    figures : mapping
        The run's figures, with its seconds and versions.
    head : sequence of str
        The verdict, and what belongs to it.
    sections : mapping
        The parts of each by anchor and title, before those that every run has.
    """
    sections = {
        **sections,
        ("files", "Files and citation"): [downloads(folder), citation(folder)],
        ("run", "The run"): details(folder, figures),
    }
    parts = [section(*name, inside) for name, inside in sections.items()]
    links = (f'<a href="#{anchor}">{escape(name)}</a>' for anchor, name in sections)
    contents = f"<nav>{' '.join(links)}</nav>"
    return page(title, [contents, *head, provenance(folder, channels), *parts])


def details(folder: Path, figures: Mapping[str, Any]) -> list[str]:
    """Tables of seconds and versions, and the resolved scenario."""
    scenario = read_text(folder / "scenario.yaml", "a scenario")
    for name in ("seconds", "versions"):
        if not isinstance(figures.get(name), dict):
            raise InputError(f"the figures of the run in '{folder}' have no {name}; make it again")
    seconds = [(name, f"{value} s") for name, value in figures["seconds"].items()]
    seconds.append(("peak memory", f"{figures['peak_memory_gb']:.2f} GB"))
    return [
        table(("stage", "time"), seconds),
        folded("versions", table(("package", "version"), figures["versions"].items())),
        folded(
            "the resolved scenario: running it again gives the same numbers",
            preformatted(scenario),
        ),
    ]
