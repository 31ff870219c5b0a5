"""The code of the documentation runs: Python and commands of each page, in order, in a folder.

What the pages say at full size is done with few modes, samples and draws here.
"""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import jax
import pytest
from matplotlib.figure import Figure

from lusee_bayes.cli import main
from lusee_bayes.scenario import load_scenario

DOCS = Path(__file__).parents[1] / "docs"
PAGES = [DOCS / "extend.md", *sorted((DOCS / "howto").glob("*.md"))]
SMALL = ["--set", "lmax=4", "--set", "observation.step_s=86400"]
SIZES = re.compile(r"\b(lmax=|LMAX = )\d+")
FENCES = re.compile(r"^```(python|sh)\n(.*?)^```", flags=re.DOTALL | re.MULTILINE)


def run_command(line: str) -> None:
    """A line of a page, made small."""
    program, *arguments = shlex.split(line, comments=True)
    assert program == "lusee-bayes"
    if arguments[0] in ("simulate", "map", "sample", "plan"):
        arguments += SMALL
    if arguments[0] == "sample":
        for name, value in (("--draws", "50"), ("--warmup", "60"), ("--chains", "2")):
            if name in arguments:
                arguments[arguments.index(name) + 1] = value
            else:
                arguments += [name, value]
    assert main(arguments) == 0, line


@pytest.fixture
def no_figures(monkeypatch):
    """Drawing is a third of the time, and other tests' business."""
    monkeypatch.setattr(Figure, "savefig", lambda self, target, **_: Path(target).touch())


@pytest.mark.long
@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_the_code_of_a_page_runs(page, tmp_path, monkeypatch, no_figures):
    monkeypatch.chdir(tmp_path)
    namespace = {"__name__": page.stem}
    # as users have it: promotion as JAX does it by default
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        for kind, code in FENCES.findall(page.read_text()):
            if kind == "python":
                code = SIZES.sub(r"\g<1>4", code)
                exec(compile(code, page.name, "exec", dont_inherit=True), namespace)
            else:
                for line in code.replace("\\\n", " ").strip().splitlines():
                    run_command(line)


def test_the_scenarios_of_the_pages_are_scenarios(tmp_path):
    found = re.findall(r"```yaml\n(.*?)```", (DOCS / "scenarios.md").read_text(), flags=re.DOTALL)
    assert found
    for text in found:
        path = tmp_path / "mine.yaml"
        path.write_text(text)
        load_scenario(path)
