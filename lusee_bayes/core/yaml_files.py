"""YAML 1.2 as scenarios use it: dates stay text; a key that comes twice is an error."""

from __future__ import annotations

from io import StringIO
from pathlib import Path
from typing import Any

from ruamel.yaml import YAML, YAMLError
from ruamel.yaml.constructor import SafeConstructor

from lusee_bayes.core.errors import InputError
from lusee_bayes.core.reading import read_text


class _Constructor(SafeConstructor):
    """The safe one, without dates."""


_Constructor.add_constructor("tag:yaml.org,2002:timestamp", lambda _, node: node.value)


def _yaml() -> YAML:
    plain = YAML(typ="safe", pure=True)
    plain.Constructor = _Constructor
    plain.default_flow_style = False
    plain.allow_unicode = False  # line breaks of Unicode would not come back
    plain.sort_base_mapping_type_on_output = False
    return plain


def parse_yaml(text: str, where: str) -> Any:
    """Parse YAML.

    Parameters
    ----------
    text : str
    where : str
        What it is, for messages.

    Returns
    -------
    object
        Lists, mappings, numbers, text, booleans and None.

    Raises
    ------
    InputError
        If it is not valid.
    """
    try:
        return _yaml().load(text)
    except (YAMLError, ValueError, RecursionError) as error:
        problem, mark = getattr(error, "problem", None), getattr(error, "problem_mark", None)
        words = " ".join(str(problem or error).split())
        place = "" if mark is None else f" (line {mark.line + 1})"
        raise InputError(f"{where} is not valid YAML: {words}{place}") from error


def read_yaml(path: str | Path, what: str, hint: str = "") -> Any:
    """Read a YAML file. InputError if it cannot be read, or as :func:`parse_yaml`."""
    return parse_yaml(read_text(path, what, hint), str(path))


def as_yaml(tree: Any, *, flow: bool = False) -> str:
    """Write lists, mappings and plain values as YAML, in a line if ``flow``."""
    written, plain = StringIO(), _yaml()
    plain.default_flow_style = flow
    plain.dump(tree, written)
    return written.getvalue()
