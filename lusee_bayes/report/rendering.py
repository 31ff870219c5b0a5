"""Rendering pages from templates: functions for all templates, and context for pages of runs.

``templates/`` contains the text, tables and captions of a page; the modules of this package read
and compute the values. A page is one self-contained file. The page of a run begins with its verdict
and the origin of the data. It ends with links to its files, how to cite it, and how it was made:
scenario, versions, times, memory.
"""

import base64
import re
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined, select_autoescape
from markupsafe import Markup

from lusee_bayes.core import checks, files, version
from lusee_bayes.core.reading import read_text
from lusee_bayes.judge import chi2, convergence
from lusee_bayes.results.finished_runs import Provenance, text_hash

# symbols as terminals write them, and as pages do
SYMBOLS = {r"\bchi(2\b|\^2)": "chi²", r"\+-": "±", r"\bell\b": "\N{SCRIPT SMALL L}"}


def render(template: str, folder: Path, **context: Any) -> str:
    """Render a page, or a part of one, as text.

    Bytes of file names that are not UTF-8 are shown as escapes.

    Parameters
    ----------
    template : str
        Name of a file in ``templates/``.
    folder : Path
        Folder of the results, with pictures in ``figures/``.
    **context
        Other variables of the template.

    Raises
    ------
    InputError
        If the template shows a picture that the folder lacks.
    """
    shown = {f.__name__: partial(f, folder) for f in (picture, pictures, has_picture)}
    return version.printable(ENVIRONMENT.get_template(template).render(context | shown))


def render_text(template: str, **context: Any) -> str:
    """Render a Markdown file of ``templates/``, without pictures, as text."""
    return ENVIRONMENT.get_template(template).render(context).rstrip() + "\n"


def has_picture(folder: Path, name: str) -> bool:
    """Whether a run has a picture of this name."""
    return (folder / "figures" / f"{name}.png").is_file()


def pictures(folder: Path, name: str) -> list[str]:
    """Names of a run's pictures that belong side by side, in order."""
    names = [path.stem for path in (folder / "figures").glob(f"{name}_[0-9]*_*.png")]
    return sorted(names, key=lambda one: int(one.removeprefix(f"{name}_").partition("_")[0]))


def picture(folder: Path, name: str) -> str:
    """A picture of a run as a data URL. InputError if the run has none."""
    files.require_files(folder, (f"figures/{name}.png",), "map")
    data = (folder / "figures" / f"{name}.png").read_bytes()
    return f"data:image/png;base64,{base64.b64encode(data).decode()}"


def asset(name: str) -> Markup:
    """A style sheet or script of ``templates/``, unchanged."""
    return Markup(ENVIRONMENT.loader.get_source(ENVIRONMENT, name)[0])


def formatted(value: Any, form: str, missing: str = "") -> str:
    """Format a number.

    Parameters
    ----------
    value : number or None
        Text is returned unchanged.
    form : str
        Format of Python's ``format``.
    missing : str
        Replaces None and NaN.
    """
    if value is None or value != value:
        return missing
    return value if isinstance(value, str) else format(value, form)


def p_value(p: float, missing: str = "") -> str:
    """Format a probability (:func:`.probability`) for a column; ``missing`` for NaN."""
    return missing if p != p else chi2.probability(p).removeprefix("= ")


def typeset(value: Any) -> Any:
    """Replace symbols in a terminal's text by those of a page: chi², ± and the script l."""
    if not isinstance(value, str) or isinstance(value, Markup):
        return value
    for plain, symbol in SYMBOLS.items():
        value = re.sub(plain, symbol, value)
    return value


ENVIRONMENT = Environment(
    loader=PackageLoader("lusee_bayes.report"),
    finalize=typeset,
    autoescape=select_autoescape(),
    undefined=StrictUndefined,
    trim_blocks=True,
    lstrip_blocks=True,
)
ENVIRONMENT.filters |= {"number": formatted, "probability": p_value}
ENVIRONMENT.globals |= {"asset": asset, "counted": checks.counted, "CRITERIA": convergence.CRITERIA}
ENVIRONMENT.globals |= {"RULE": chi2.RULE, "HEADLINES": chi2.HEADLINES}


def render_run(template: str, path: Path, run: Mapping[str, Any], **context: Any) -> str:
    """Render the page of a run from a template that extends ``run.html``.

    Parameters
    ----------
    template : str
    path : Path
        File of the run's figures, in its folder.
    run : mapping
        The figures, with the run's seconds, versions and peak memory.
    **context
        As in :func:`render`.

    Raises
    ------
    InputError
        If the scenario is missing, and as :func:`render`.
    """
    folder = path.parent
    scenario = read_text(folder / "scenario.yaml", "a scenario")
    return render(
        template,
        folder,
        run=run,
        doubts=run.get("doubts", ()),
        notes=run.get("notes", ()),
        provenance=Provenance.read(folder),
        scenario=scenario,
        scenario_hash=text_hash(scenario)[:12],
        bytes_of={file.name: file.stat().st_size for file in folder.iterdir() if file.is_file()},
        **context,
    )
