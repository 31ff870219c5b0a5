"""Every notebook runs from top to bottom, and is kept with small, clean outputs."""

import re
from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

NOTEBOOKS = sorted((Path(__file__).parents[2] / "notebooks").glob("*.ipynb"))
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
        assert output.output_type != "error"
        assert output.get("name") != "stderr"
        assert ABSOLUTE_PATH.search(text_of(output)) is None


@each_notebook
def test_links_lead_somewhere(path):
    """Relative links of the text, to other notebooks and to pages."""
    notebook = nbformat.read(path, as_version=4)
    text = "\n".join(cell.source for cell in notebook.cells if cell.cell_type == "markdown")
    for target in re.findall(r"\]\(([^)#]+)", text):
        assert target.startswith("https://") or (path.parent / target).exists(), target
