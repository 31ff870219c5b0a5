"""The worked examples of docs/extend.md, applied to a copy of the package, pass their tests."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
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


def test_a_worked_example_touches_four_files_at_most():
    page = (ROOT / "docs" / "extend.md").read_text()
    part = page[page.index("## In the package, file by file") :]
    examples = part.split("\n### ")[1:]
    assert len(examples) == 4
    for example in examples:
        touched = {match["path"] for match in BLOCK.finditer(example)}
        assert 2 <= len(touched) <= 4, touched
        assert any(path.startswith("tests/") for path in touched)


@pytest.mark.long
@pytest.mark.essential
def test_the_worked_examples_pass_their_tests(tmp_path):
    for folder in ("lusee_bayes", "models"):
        shutil.copytree(ROOT / folder, tmp_path / folder)
    (tmp_path / "tests").mkdir()
    for match in BLOCK.finditer((ROOT / "docs" / "extend.md").read_text()):
        path = tmp_path / match["path"]
        if match["how"] is None:
            assert not path.exists(), path
            path.write_text(match["code"])
        else:
            changed = applied(path.read_text(), match["how"], match["line"], match["code"])
            path.write_text(changed)
    environment = os.environ | {"PYTHONPATH": str(tmp_path), "MPLBACKEND": "agg"}
    found = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", str(tmp_path / "tests")],
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert found.returncode == 0, found.stdout[-3000:]
    assert "6 passed" in found.stdout
