"""Pieces of a page: sections, figures, tables; everything inside one file."""

from __future__ import annotations

import base64
from collections.abc import Iterable, Sequence
from html import escape
from importlib import resources
from pathlib import Path
from urllib.parse import quote

from lusee_bayes.core.version import printable

TEMPLATE = """<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<link rel="icon" href="data:,">
<title>{title}</title>
<style>
{style}
</style>
</head>
<body>
<h1>{title}</h1>
{body}
</body>
</html>
"""


def page(title: str, parts: Iterable[str]) -> str:
    """A whole document that needs nothing but itself.

    Bytes of file names that are no UTF-8 are shown by their escapes.
    """
    style = package_text("report.css")
    text = TEMPLATE.format(title=escape(title), style=style, body="\n".join(parts))
    return printable(text)


def package_text(name: str) -> str:
    """A file that lies beside this module."""
    return (resources.files("lusee_bayes.report") / name).read_text(encoding="utf-8")


def contents(sections: Sequence[tuple[str, str]]) -> str:
    """Links to sections (anchor, title)."""
    links = (f'<a href="#{anchor}">{escape(title)}</a>' for anchor, title in sections)
    return f"<nav>{' '.join(links)}</nav>"


def section(anchor: str, title: str, *parts: str) -> str:
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


def _cell(value: object) -> str:
    return value if isinstance(value, Markup) else escape(str(value))


def figure(path: Path, alternative: str, caption: str) -> str:
    """A picture, inside the page, with a text for those who do not see it."""
    data = base64.b64encode(path.read_bytes()).decode()
    return (
        f'<figure><div class="scroll"><img src="data:image/png;base64,{data}" '
        f'alt="{escape(alternative)}"></div><p class="cue">Swipe the figure sideways.</p>'
        f"<figcaption>{escape(caption)}</figcaption></figure>"
    )


def table(
    header: Sequence[str], rows: Iterable[Sequence[object]], bad: Sequence[bool] | None = None
) -> str:
    """A table; rows that are ``bad`` stand out."""
    rows = list(rows)
    marks = bad if bad is not None else [False] * len(rows)
    head = "".join(f'<th scope="col">{escape(str(cell))}</th>' for cell in header)
    lines = [
        f"<tr{' class=bad' if mark else ''}>"
        + "".join(f"<td>{_cell(cell)}</td>" for cell in row)
        + "</tr>"
        for row, mark in zip(rows, marks, strict=True)
    ]
    return (
        f'<div class="scroll"><table><thead><tr>{head}</tr></thead>\n<tbody>\n'
        + "\n".join(lines)
        + "\n</tbody></table></div>"
    )


def preformatted(text: str) -> str:
    """Text as it is, letter by letter."""
    return f"<pre>{escape(text)}</pre>"


def folded(summary: str, *parts: str) -> str:
    """What is seen when it is asked for."""
    return f"<details><summary>{escape(summary)}</summary>\n" + "\n".join(parts) + "\n</details>"
