"""The code of the documentation runs, and its lists are complete.

Python and commands of each page run in order, in a folder of their own, with few modes, samples and
draws.
"""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import jax
import numpy as np
import pytest
from matplotlib.figure import Figure

import lusee_bayes as lb
from lusee_bayes.cli.main import main
from lusee_bayes.core.harmonics import from_healpy
from lusee_bayes.core.reading import parse_yaml
from lusee_bayes.experiment.scenario import load_scenario, scenario_names

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
PAGES = [DOCS / "extend.md", *sorted((DOCS / "howto").glob("*.md"))]
SMALL = ["--set", "lmax=4", "--set", "observation.step_s=86400"]
SIZES = re.compile(r"\b(lmax=|LMAX = )\d+")
FENCES = re.compile(r"^```(python|sh)\n(.*?)^```", flags=re.DOTALL | re.MULTILINE)


def run_command(line: str) -> None:
    """Run a line of a page at a small size."""
    program, *arguments = shlex.split(line, comments=True)
    assert program == "lusee-bayes"
    if arguments[0] in ("simulate", "map", "reduce", "sample", "plan"):
        arguments += SMALL
    if arguments[0] == "average":
        arguments[arguments.index("--to") + 1] = "3d"
        arguments += SMALL[:2]
    if arguments[0] == "sample":
        for name, value in (("--draws", "50"), ("--warmup", "60"), ("--chains", "2")):
            if name in arguments:
                arguments[arguments.index(name) + 1] = value
            else:
                arguments += [name, value]
    assert main(arguments) == 0, line


@pytest.fixture
def no_figures(monkeypatch):
    """Drawing takes a third of the time, and other tests check it."""
    monkeypatch.setattr(Figure, "savefig", lambda self, target, **_: Path(target).touch())


@pytest.mark.long
@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_the_code_of_a_page_runs(page, tmp_path, monkeypatch, no_figures):
    monkeypatch.chdir(tmp_path)
    namespace = {"__name__": page.stem}
    # users have JAX's default promotion
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        for kind, code in FENCES.findall(page.read_text()):
            if kind == "python":
                code = SIZES.sub(r"\g<1>4", code)
                exec(compile(code, page.name, "exec", dont_inherit=True), namespace)
            else:
                for line in code.replace("\\\n", " ").strip().splitlines():
                    run_command(line)


@pytest.mark.long
def test_the_commands_of_the_readme_run(tmp_path, monkeypatch, no_figures):
    monkeypatch.chdir(tmp_path)
    code = "".join(text for kind, text in FENCES.findall((ROOT / "README.md").read_text())
                   if kind == "sh")  # fmt: skip
    lines = code.splitlines()
    # what only a shell does comes before the first command: the environment is activated
    assert lines.index(". .venv/bin/activate") < min(
        k for k, line in enumerate(lines) if line.startswith("lusee-bayes")
    )
    for line in lines:
        if line.startswith("lusee-bayes"):
            run_command(line)


@pytest.mark.long
def test_the_draws_of_the_readme_become_healpys(tmp_path, monkeypatch, no_figures):
    blocks = [c for kind, c in FENCES.findall((ROOT / "README.md").read_text()) if kind == "python"]
    (block,) = [b for b in blocks if "posterior.nc" in b]
    monkeypatch.chdir(tmp_path)
    run_command("lusee-bayes map fiducial --draws 100")
    made = {}
    exec(block, made)
    assert len(made["skies"]) == 100
    np.testing.assert_allclose(from_healpy(made["alm"]), made["skies"], rtol=1e-14)


def test_the_citation_names_this_version():
    citation = parse_yaml((ROOT / "CITATION.cff").read_text(), "the file")
    assert citation["cff-version"] == "1.2.0"
    # what the standard asks for
    assert {"authors", "message", "title"} <= set(citation)
    assert citation["version"] == lb.__version__
    assert f"version = {{{lb.__version__}}}" in (DOCS / "citing.md").read_text()
    readme = (ROOT / "README.md").read_text()
    assert citation["preferred-citation"]["url"] in readme


@pytest.mark.parametrize("words", ["own data", "mask", "flag", "cite"])
def test_words_that_users_search_for_are_in_the_pages(words):
    # the site's search is over whole words and their stems
    pages = [*DOCS.glob("*.md"), *DOCS.glob("howto/*.md")]
    assert any(re.search(rf"\b{words}s?\b", page.read_text(), re.IGNORECASE) for page in pages)


def test_the_scenarios_of_the_pages_are_scenarios(tmp_path):
    found = re.findall(r"```yaml\n(.*?)```", (DOCS / "scenarios.md").read_text(), flags=re.DOTALL)
    assert found
    for text in found:
        path = tmp_path / "mine.yaml"
        path.write_text(text)
        load_scenario(path)


def test_every_module_has_an_entry_in_the_api():
    pages = "".join(page.read_text() for page in (DOCS / "api").glob("*.md"))
    pages += (DOCS / "scenarios.md").read_text()
    documented = set(re.findall(r"automodule:: (\S+)", pages))
    modules = {
        ".".join(path.relative_to(ROOT).with_suffix("").parts)
        for path in (ROOT / "lusee_bayes").rglob("*.py")
        if path.stem != "__init__"
    }
    without_page = {m for m in modules if m.split(".")[1] in ("cli", "paper")}
    assert documented == modules - without_page


def test_the_table_of_public_names_is_complete():
    listed = re.findall(r"^   ~(\S+)$", (DOCS / "api" / "index.md").read_text(), re.MULTILINE)
    public = {name: getattr(lb, name) for name in lb.__all__ if name != "__version__"}
    assert sorted(listed) == sorted(f"{value.__module__}.{n}" for n, value in public.items())


def test_the_table_of_scenarios_is_complete():
    page = (DOCS / "scenarios.md").read_text()
    assert [name for name in scenario_names() if f"`{name}`" not in page] == []
