"""The house: what the package exports, and that a name means one thing."""

import ast
import pkgutil
from pathlib import Path

import pytest

import lusee_bayes as lb

PACKAGE = Path(lb.__file__).parent
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


def test_modules_are_short():
    """One idea a file: none has more than 350 lines."""
    long = {
        str(path.relative_to(PACKAGE)): n
        for path in PACKAGE.rglob("*.py")
        if (n := len(path.read_text().splitlines())) > 350
    }
    assert not long
