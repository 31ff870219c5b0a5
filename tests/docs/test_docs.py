"""The code of the documentation and the notebooks runs, and its lists are complete.

Python and commands of each page run in order, in a folder of their own, with few modes, samples and
draws.
"""

import ast
import os
import re
import shlex
import shutil
from importlib import import_module
from pathlib import Path

import jax
import jax.numpy as jnp
import nbformat
import numpy as np
import pytest
from commands import python
from matplotlib.figure import Figure
from nbclient import NotebookClient

import lusee_bayes as lb
from lusee_bayes.cli.main import main
from lusee_bayes.core import harmonics, reading
from lusee_bayes.experiment.scenario import scenario_names
from lusee_bayes.sampling.mode import estimate_evidence

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"
PAGES = [DOCS / "extend.md", *sorted((DOCS / "howto").glob("*.md"))]
TOP = "noise.above_lmax={margin: 2, least_lmax: 0}"
SMALL = ["--set", "lmax=4", "--set", "observation.step_s=86400", "--set", TOP]
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


def test_what_pages_and_notebooks_import_is_there():
    texts = [path.read_text(encoding="utf-8") for path in [ROOT / "README.md", *PAGES[1:]]]
    blocks = [code for text in texts for kind, code in FENCES.findall(text) if kind == "python"]
    for path in sorted((ROOT / "notebooks").glob("*.ipynb")):
        cells = nbformat.read(path, as_version=4).cells
        blocks += [c.source for c in cells if c.cell_type == "code" and "%" not in c.source]
    imports = [
        node
        for block in blocks
        for node in ast.walk(ast.parse(block))
        if isinstance(node, ast.ImportFrom) and node.module.startswith("lusee_bayes")
    ]
    assert imports
    for node in imports:
        module = import_module(node.module)
        assert not [name.name for name in node.names if not hasattr(module, name.name)], node.module


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
    blocks = FENCES.findall((ROOT / "README.md").read_text())
    lines = "".join(text for kind, text in blocks if kind == "sh").splitlines()
    # what only a shell does comes before the first command: the environment is activated
    commands = [k for k, line in enumerate(lines) if line.startswith("lusee-bayes")]
    assert lines.index(". .venv/bin/activate") < min(commands)
    for line in lines:
        if line.startswith("lusee-bayes"):
            run_command(line)


@pytest.mark.long
def test_the_draws_of_the_readme_become_healpys(tmp_path, monkeypatch, no_figures):
    blocks = [c for kind, c in FENCES.findall((ROOT / "README.md").read_text()) if kind == "python"]
    (block,) = [b for b in blocks if "read_draws" in b]
    monkeypatch.chdir(tmp_path)
    run_command("lusee-bayes map first_map --draws 100")
    made = {"lb": lb}
    exec(block, made)
    assert len(made["skies"]) == 100
    np.testing.assert_allclose(harmonics.from_healpy(made["alm"]), made["skies"][0], rtol=1e-14)


def test_the_citation_is_whole():
    citation = reading.parse_yaml((ROOT / "CITATION.cff").read_text(), "the file")
    assert citation["cff-version"] == "1.2.0"
    # what the standard asks for
    assert {"authors", "message", "title"} <= set(citation)
    assert f"version = {{{lb.__version__}}}" in (DOCS / "citing.md").read_text()
    method = citation["preferred-citation"]
    assert method["url"] in (ROOT / "README.md").read_text()
    # and what a release says of software and method
    metadata = (ROOT / "lusee_bayes/report/templates/release/datacite.json.jinja").read_text()
    cited = citation["title"], citation["authors"][0]["name"], method["identifiers"][0]["value"]
    assert all(f'"{name}"' in metadata for name in cited)


def test_the_scenarios_of_the_pages_are_scenarios(write):
    found = re.findall(r"```yaml\n(.*?)```", (DOCS / "scenarios.md").read_text(), flags=re.DOTALL)
    assert found
    for text in found:
        lb.load_scenario(write(text, "mine.yaml"))


def test_every_module_has_an_entry_in_the_api():
    pages = "".join(page.read_text() for page in (DOCS / "api").glob("*.md"))
    pages += (DOCS / "scenarios.md").read_text()
    documented = set(re.findall(r"automodule:: (\S+)", pages))
    modules = {
        ".".join(path.relative_to(ROOT).with_suffix("").parts)
        for path in (ROOT / "lusee_bayes").rglob("*.py")
        if path.stem != "__init__"
    }
    assert documented == modules - {m for m in modules if m.split(".")[1] in ("cli", "paper")}


def test_the_table_of_public_names_is_complete():
    listed = re.findall(r"^   ~(\S+)$", (DOCS / "api" / "index.md").read_text(), re.MULTILINE)
    public = {name: getattr(lb, name) for name in lb.__all__ if name != "__version__"}
    assert sorted(listed) == sorted(f"{value.__module__}.{n}" for n, value in public.items())


def test_the_table_of_scenarios_is_complete():
    page = (DOCS / "scenarios.md").read_text()
    assert [name for name in scenario_names() if f"`{name}`" not in page] == []


BLOCK = re.compile(
    r"^```\{code-block\} python\n:caption: (?P<path>[^\s,]+)"
    r'(?:, (?P<how>before|after|instead of) "(?P<line>[^\n]*)")?\n\n(?P<code>.*?)^```',
    flags=re.DOTALL | re.MULTILINE,
)


def applied(text: str, how: str, line: str, code: str) -> str:
    """A file with a block put before, after or in place of the line that begins so."""
    lines = text.splitlines(keepends=True)
    places = [k for k, there in enumerate(lines) if there.startswith(line)]
    assert len(places) == 1, f"{line!r} stands {len(places)} times"
    first, rest = places[0], places[0] + 1
    if how == "before":
        rest = first
    elif how == "after":
        first = rest
    return "".join([*lines[:first], code, *lines[rest:]])


@pytest.mark.essential
def test_the_worked_examples_pass_their_tests(tmp_path):
    for folder in ("lusee_bayes", "models"):
        shutil.copytree(ROOT / folder, tmp_path / folder)
    (tmp_path / "tests").mkdir()
    for match in BLOCK.finditer((DOCS / "extend.md").read_text()):
        path = tmp_path / match["path"]
        if match["how"] is None:
            assert not path.exists(), path
            path.write_text(match["code"])
        else:
            path.write_text(applied(path.read_text(), match["how"], match["line"], match["code"]))
    environment = os.environ | {"PYTHONPATH": str(tmp_path), "MPLBACKEND": "agg"}
    given = "-m", "pytest", "-q", "-p", "no:cacheprovider", "tests"
    found = python(*given, cwd=tmp_path, env=environment, check=False)
    assert found.returncode == 0, found.stdout[-3000:]
    assert "6 passed" in found.stdout


NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))
each_notebook = pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda p: p.stem)

MOST_BYTES = 600_000
# from the root of a machine, or of somebody's home
ABSOLUTE_PATH = re.compile(r"(?<![\w.:/])(?:/(?:home|root|tmp|usr|opt|var|work|Users)/|[A-Z]:\\)")


def outputs(notebook):
    """All outputs of all cells."""
    return [o for cell in notebook.cells if cell.cell_type == "code" for o in cell.outputs]


def text_of(output) -> str:
    """Everything in an output that is not an image."""
    if output.output_type == "stream":
        return output.text
    return "\n".join(str(v) for kind, v in output.data.items() if not kind.startswith("image/"))


def run(path, monkeypatch):
    """Execute a notebook in its folder; an error of a cell is raised."""
    # tqdm's opinion of an environment without widgets
    monkeypatch.setenv("PYTHONWARNINGS", "ignore:IProgress not found")
    notebook = nbformat.read(path, as_version=4)
    where = {"metadata": {"path": str(path.parent)}}
    NotebookClient(notebook, timeout=180, kernel_name="python3", resources=where).execute()
    made = outputs(notebook)
    assert made
    assert [o.text for o in made if o.output_type == "stream" and o.name == "stderr"] == []
    return made


@pytest.mark.long
@pytest.mark.filterwarnings("default")  # Jupyter's own warnings are not ours
@each_notebook
def test_notebook_runs(path, monkeypatch):
    run(path, monkeypatch)


@pytest.mark.long
@pytest.mark.filterwarnings("default")
def test_luseepy_files_runs_without_the_files(tmp_path, monkeypatch):
    monkeypatch.setenv("LUSEE_BAYES_TEST_DATA", str(tmp_path / "nothing"))
    (path,) = [p for p in NOTEBOOKS if p.stem == "luseepy_files"]
    text = "".join(text_of(output) for output in run(path, monkeypatch))
    assert "the team's files are not here" in text


@each_notebook
def test_kept_outputs_are_small_and_clean(path):
    notebook = nbformat.read(path, as_version=4)
    nbformat.validate(notebook)
    assert path.stat().st_size < MOST_BYTES
    assert any("image/png" in o.get("data", {}) for o in outputs(notebook))
    for output in outputs(notebook):
        assert output.output_type != "error" and output.get("name") != "stderr"
        assert ABSOLUTE_PATH.search(text_of(output)) is None


@each_notebook
def test_links_lead_somewhere(path):
    """Relative links of the text, to other notebooks and to pages."""
    notebook = nbformat.read(path, as_version=4)
    text = "\n".join(cell.source for cell in notebook.cells if cell.cell_type == "markdown")
    for target in re.findall(r"\]\(([^)#]+)", text):
        assert target.startswith("https://") or (path.parent / target).exists(), target


@pytest.mark.long
def test_both_faces_of_the_guides_systematic_have_one_evidence():
    ((_, code),) = FENCES.findall((DOCS / "systematics.md").read_text())
    made = {}
    exec("import jax\n" + code, made)
    rng = np.random.default_rng(1)
    a, noise = jnp.asarray(rng.normal(size=(30, 9))), lb.DiagonalCovariance(jnp.full(30, 0.1))
    gaussian = lb.LinearGaussian(a, lb.HarmonicPrior(jnp.ones(3)), noise)
    cable = made["CablePickup"](jnp.asarray(rng.normal(size=30)), 0.7)
    data = gaussian.sample(jax.random.key(0))[1] + 0.5 * cable.pattern
    program = lb.load_program("systematics")
    found = estimate_evidence(program, {"gaussian": gaussian, "systematics": (cable,)}, data)
    exact = float(cable.marginalised(gaussian).log_prob(data))
    # a Gaussian is what the proposal is about, so that nearly every draw counts
    assert found.effective > 200
    assert found.error < 0.05
    assert found.log_evidence == pytest.approx(exact, abs=5 * found.error)
    assert float(gaussian.log_prob(data)) < exact - 1.0
