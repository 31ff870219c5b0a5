"""The house: what the package exports, and that a name means one thing."""

import ast
import pkgutil
import re
from pathlib import Path

import pytest

import lusee_bayes as lb
from lusee_bayes.core.version import commit, release, versions

PACKAGE = Path(lb.__file__).parent
ROOT = PACKAGE.parent
MODULES = {
    module.name.rsplit(".", 1)[-1]: module.name
    for module in pkgutil.walk_packages(lb.__path__, "lusee_bayes.")
}


def test_exports_are_static_and_are_what_they_say():
    """Every public name stands in __init__.pyi, as a type checker reads it, and is there."""
    stub = ast.parse((PACKAGE / "__init__.pyi").read_text())
    exported = {}
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


@pytest.mark.parametrize("name", sorted(lb.__all__))
def test_no_public_name_is_a_modules(name):
    assert name not in MODULES


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
    named = [p for p in files if "install 'lusee_bayes[" in p.read_text(encoding="utf-8")]
    assert not named


def test_every_text_names_its_encoding():
    """Whatever the locale, files are UTF-8."""
    for path in PACKAGE.rglob("*.py"):
        for call in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if not isinstance(call, ast.Call) or not isinstance(call.func, ast.Attribute):
                continue
            mode = (
                call.args[0].value if call.args and isinstance(call.args[0], ast.Constant) else ""
            )
            opens = call.func.attr == "open" and mode in ("r", "w", "a", "x")
            if opens or call.func.attr in ("read_text", "write_text"):
                assert any(one.arg == "encoding" for one in call.keywords), (path, call.lineno)
