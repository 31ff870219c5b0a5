"""What the pages need beyond Sphinx: plain docstrings, short signatures, the commands' help.

The docstrings are plain text. What they indent is an equation, ``name : text`` tells of a
parameter, and ``|N|`` or ``A^T`` mean what they say; Sphinx reads reStructuredText.
"""

from __future__ import annotations

import inspect
import io
import json
import re
from importlib import resources
from pathlib import Path
from typing import get_args

from docutils import nodes
from pydantic import BaseModel
from pydantic_core import PydanticUndefined
from rich.console import Console
from sphinx.util import logging
from sphinx.util.docutils import SphinxDirective

import lusee_bayes
from lusee_bayes.cli import app as command_line
from lusee_bayes.scenario import Scenario, scenario_names

logger = logging.getLogger(__name__)

# a parameter's or an attribute's name, at the start of a paragraph, a line or behind a semicolon
NAME = r"\w+(?:, \w+)*"
ENTRY = re.compile(rf"(?:^|(?<=[;,.] )|(?<=\n))(?P<name>{NAME}) : ")
LITERAL = re.compile(
    r"(``.*?``|:\w+:`[^`]*`|`[^`]*`|(?<!\w)\*\w+\*(?!\w))",  # the last one is *emphasis*
    flags=re.DOTALL,
)
WIDTH = 88


def plain_docstring(app, what, name, obj, options, lines: list[str]) -> None:
    """From the package's plain text to reStructuredText, paragraph by paragraph."""
    text = "\n".join(lines).strip()
    if not text:
        return
    paragraphs = []
    for paragraph in re.split(r"\n\s*\n", text):
        paragraphs.extend(_paragraph(paragraph))
    lines[:] = [*"\n\n".join(paragraphs).split("\n"), ""]


def _paragraph(paragraph: str) -> list[str]:
    rows = paragraph.split("\n")
    if rows[0].startswith("    "):
        return ["::", paragraph]
    if re.match(r"[*-] ", paragraph):
        return [_escaped(re.sub(r"^\* ", "- ", paragraph, flags=re.MULTILINE))]
    indented = next((i for i, row in enumerate(rows) if row.startswith("    ")), None)
    if indented is not None:
        # an equation without a blank line before it
        return [*_paragraph("\n".join(rows[:indented])), "::", "\n".join(rows[indented:])]
    entries = list(ENTRY.finditer(paragraph))
    if not entries or entries[0].start() != 0:
        return [_escaped(paragraph)]
    ends = [entry.start() for entry in entries[1:]] + [len(paragraph)]
    items = []
    for entry, end in zip(entries, ends, strict=True):
        words = _escaped(" ".join(paragraph[entry.end() : end].split()).rstrip(";,"))
        items.append(f"- **{entry['name']}**: {words}")
    return ["\n".join(items)]


def _escaped(text: str) -> str:
    """Stars, bars and trailing underscores are characters here, not markup."""
    parts = LITERAL.split(text)
    for i in range(0, len(parts), 2):
        parts[i] = re.sub(r"([*|\\])|(_)(?=\W|$)", r"\\\1\2", parts[i])
    return "".join(parts)


def short_signature(app, what, name, obj, options, signature, returns):
    """Names of types as they are written in the source."""
    return _short(signature), _short(returns)


def _short(text: str | None) -> str | None:
    if text is None:
        return None
    text = re.sub(r"~?jaxtyping\.", "", text).replace("[Array, ' ", "[Array, '")
    # unions that have a name in the source
    either = r"(\w+)\[Array, ('[^']*')\] \| \1\[ndarray, \2\]"
    key = r"Key\[Array, ''\] \| UInt32\[Array, '2'\] \| UInt32\[Array, '4'\]"
    return re.sub(key, "PRNGKeyArray", re.sub(either, r"\1[AnyArray, \2]", text))


class Commands(SphinxDirective):
    """``{commands}``: a section for every command, with what ``--help`` prints."""

    def run(self) -> list[nodes.Node]:
        """The sections."""
        names = [name for name in command_line if not name.startswith("-")]
        sections = [_section(name, _help_of(name)) for name in names]
        for section in sections:
            self.state.document.note_implicit_target(section)
        return [_block(_help_of()), *sections]


def _section(title: str, text: str) -> nodes.section:
    heading = nodes.title("", "", nodes.literal("", title))
    return nodes.section("", heading, _block(text), names=[title])


def _block(text: str) -> nodes.literal_block:
    return nodes.literal_block(text, text, language="text")


def _help_of(*command: str) -> str:
    out = io.StringIO()
    console = Console(file=out, width=WIDTH, force_terminal=False, color_system=None)
    command_line.help_print(command, console=console)
    return "\n".join(line.rstrip() for line in out.getvalue().strip().split("\n"))


class ScenarioNames(SphinxDirective):
    """``{scenario-names}``: the scenarios of the package, each with its file's first line."""

    def run(self) -> list[nodes.Node]:
        """A table."""
        rows = ["| name | what |", "| --- | --- |"]
        for name in scenario_names():
            text = (resources.files("lusee_bayes") / "scenarios" / f"{name}.yaml").read_text()
            comment = re.match(r"(?:# .*\n)+", text)
            what = " ".join(comment.group().replace("# ", " ").split()) if comment else ""
            rows.append(f"| `{name}` | {what} |")
        return self.parse_text_to_nodes("\n".join(rows))


class ScenarioKeys(SphinxDirective):
    """``{scenario-keys}``: every key of a scenario with its default, section by section."""

    def run(self) -> list[nodes.Node]:
        """A paragraph and a table for each section."""
        return self.parse_text_to_nodes("\n\n".join(_keys(Scenario, "")))


def _keys(section: type[BaseModel], path: str) -> list[str]:
    rows, below = ["| key | default |", "| --- | --- |"], []
    for name, field in section.model_fields.items():
        key = f"{path}.{name}" if path else name
        if (inner := _section_of(field.annotation)) is not None:
            default = "one" if name == "runs" else "none" if not field.default else "see below"
            below += _keys(inner, f"{key}.0" if default == "one" or name == "list" else key)
        else:
            default = _as_yaml(field.default)
        rows.append(f"| `{key}` | {default} |")
    found = []
    if path:
        text = inspect.getdoc(section).replace("``", "`")
        found = [f"**{path}**", *(" ".join(p.split()) for p in text.split("\n\n"))]
    return [*found, "\n".join(rows), *below]


def _section_of(annotation: object) -> type[BaseModel] | None:
    """The section behind an annotation, also where it may be absent or there are several."""
    for kind in (annotation, *get_args(annotation)):
        if isinstance(kind, type) and issubclass(kind, BaseModel):
            return kind
    return None


def _as_yaml(default: object) -> str:
    if default is PydanticUndefined:
        return "has to be given"
    if isinstance(default, tuple):
        default = list(default)
    return f"`{json.dumps(default)}`"


class PublicNames(SphinxDirective):
    """``{public-names}``: ``lusee_bayes.__all__``, with the first line of each docstring."""

    def run(self) -> list[nodes.Node]:
        """A table whose names link to the pages of the areas."""
        rows = ["| name | what |", "| --- | --- |"]
        for name, home in sorted(public_homes().items(), key=lambda pair: pair[0].lower()):
            first = inspect.getdoc(getattr(lusee_bayes, name)).split("\n\n")[0]
            first = " ".join(first.split()).replace("|", r"\|").replace("*", r"\*")
            rows.append(f"| {{py:obj}}`{name} <{home}>` | {first} |")
        return self.parse_text_to_nodes("\n".join(rows))


def public_homes() -> dict[str, str]:
    """Where each public name of the package is documented."""
    homes = {n: f"lusee_bayes.{h}.{n}" for n, h in lusee_bayes._HOMES.items()}
    return homes | {"InputError": "lusee_bayes.checks.InputError"}


def every_public_name_is_told(app, env) -> None:
    """A warning, which fails the build, for a public name that no page documents."""
    known = env.get_domain("py").objects
    for home in public_homes().values():
        if home not in known:
            logger.warning("%s is public and on no page; add its module to docs/api", home)


def nothing_is_fetched(app, exception) -> None:
    """A warning for a page that needs a file from the network."""
    if exception is not None or app.builder.format != "html":
        return
    fetched = re.compile(r"<(?:script|img|link|iframe)\b[^>]*\b(?:src|href)=[\"']?(?:https?:)?//")
    for page in Path(app.outdir).rglob("*.html"):
        if found := fetched.search(page.read_text()):
            logger.warning("%s fetches a file: %s", page.name, found.group())


def setup(app):
    """Sphinx calls this."""
    app.connect("autodoc-process-docstring", plain_docstring)
    app.connect("autodoc-process-signature", short_signature)
    app.connect("env-check-consistency", every_public_name_is_told)
    app.connect("build-finished", nothing_is_fetched)
    app.add_directive("commands", Commands)
    app.add_directive("public-names", PublicNames)
    app.add_directive("scenario-names", ScenarioNames)
    app.add_directive("scenario-keys", ScenarioKeys)
    return {"parallel_read_safe": True}
