"""The house: what the package exports, and that a name means one thing."""

import ast
import io
import pkgutil
import re
import tokenize
from collections import Counter
from pathlib import Path

import pytest

import lusee_bayes as lb
from lusee_bayes.core.version import commit, release, versions

PACKAGE = Path(lb.__file__).parent
ROOT = PACKAGE.parent


def test_exports_are_static_and_are_what_they_say():
    """Every public name stands in __init__.pyi, as a type checker reads it, and is there."""
    stub, exported = ast.parse((PACKAGE / "__init__.pyi").read_text()), {}
    for statement in stub.body:
        assert isinstance(statement, ast.ImportFrom)
        assert statement.level == 1
        for alias in statement.names:
            assert alias.asname == alias.name, "as re-exports are written: from .x import Y as Y"
            exported[alias.name] = statement.module
    assert sorted(lb.__all__) == sorted(exported)
    for name, module in exported.items():
        value = getattr(lb, name)
        if name != "__version__":
            assert value.__name__ == name
            assert value.__module__.startswith(f"lusee_bayes.{module}"), name
            assert value.__doc__


def test_no_public_name_is_a_modules():
    modules = pkgutil.walk_packages(lb.__path__, "lusee_bayes.")
    assert not {module.name.rsplit(".", 1)[-1] for module in modules} & set(lb.__all__)


def test_what_is_not_exported_is_an_attribute_error():
    with pytest.raises(AttributeError, match="no_such_name"):
        _ = lb.no_such_name


def test_there_is_one_version():
    cited = re.search(r'^version: "(.*)"$', (ROOT / "CITATION.cff").read_text(), re.MULTILINE)
    logged = re.search(r"^## (\S+)", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)
    assert cited[1] == logged[1] == lb.__version__
    assert release().startswith(lb.__version__) and versions()["lusee_bayes"] == lb.__version__
    assert versions().get("commit") == commit() and "commit" not in versions(with_commit=False)


def test_advice_names_no_package_of_an_index():
    files = [*PACKAGE.rglob("*.py"), *(ROOT / "docs").rglob("*.md"), ROOT / "README.md"]
    assert not [p for p in files if "install 'lusee_bayes[" in p.read_text(encoding="utf-8")]


def test_every_text_names_its_encoding():
    """Whatever the locale, files are UTF-8."""
    for path in PACKAGE.rglob("*.py"):
        for call in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if not isinstance(call, ast.Call) or not isinstance(call.func, ast.Attribute):
                continue
            mode = getattr(call.args[0], "value", "") if call.args else ""
            opens = call.func.attr == "open" and mode in ("r", "w", "a", "x")
            if opens or call.func.attr in ("read_text", "write_text"):
                assert any(one.arg == "encoding" for one in call.keywords), (path, call.lineno)


def lines_of_code(path):
    """Lines without blank ones, comments and docstrings, and how many of them are imports."""
    text = path.read_text(encoding="utf-8")
    tree = ast.parse(text)
    documented = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)
    docstrings = {
        line
        for node in ast.walk(tree)
        if isinstance(node, documented) and ast.get_docstring(node, clean=False) is not None
        for line in range(node.body[0].lineno, node.body[0].end_lineno + 1)
    }
    code = {
        line
        for token in tokenize.generate_tokens(io.StringIO(text).readline)
        if token.string.strip() and token.type != tokenize.COMMENT
        for line in range(token.start[0], token.end[0] + 1)
    }
    imports = {
        line
        for node in ast.walk(tree)
        if isinstance(node, ast.Import | ast.ImportFrom)
        for line in range(node.lineno, node.end_lineno + 1)
    }
    return len(code - docstrings), len(imports)


def test_every_folder_keeps_its_budget():
    """The budgets are those of docs/house.md; new lines name those that go."""
    house = (ROOT / "docs" / "house.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| `(\w+)` \|.*\| ([\d,]+) \|$", house, re.MULTILINE)
    budgets = {folder: int(most.replace(",", "")) for folder, most in rows}
    paths = list(PACKAGE.rglob("*.py"))
    counted = [(path.relative_to(PACKAGE).parts, *lines_of_code(path)) for path in paths]
    spent = Counter()
    for parts, code, _ in counted:
        spent[parts[0] if len(parts) > 1 else ""] += code
    assert spent.keys() - {""} <= budgets.keys()
    assert not {f: n for f, n in spent.items() if f and n > budgets[f]}
    total = sum(spent.values())
    assert total <= 25_000
    assert len(paths) <= 170
    assert sum(imports for *_, imports in counted) <= 0.11 * total
    assert sum(lines_of_code(path)[0] for path in (ROOT / "tests").rglob("*.py")) <= 20_000


def test_a_name_means_one_thing():
    """No two public classes, functions or files of the package have the same name."""
    files = [path for path in PACKAGE.rglob("*.py") if path.stem not in ("__init__", "__main__")]
    defined = Counter(
        node.name
        for path in files
        for node in ast.parse(path.read_text(encoding="utf-8")).body
        if isinstance(node, ast.ClassDef | ast.FunctionDef) and not node.name.startswith("_")
    )
    assert not [name for name, n in defined.items() if n > 1]
    assert not [name for name, n in Counter(path.stem for path in files).items() if n > 1]
