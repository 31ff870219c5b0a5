"""``--set key.path=value``: changing one entry of a tree of keys and values."""

from __future__ import annotations

from typing import Any

from lusee_bayes.core.errors import InputError
from lusee_bayes.core.reading import parse_yaml


def apply_override(tree: dict[str, Any], override: str) -> None:
    """Set one entry of ``tree``; list entries by number, as in observation.runs.0.cycles=2.

    InputError, naming the override, if it is not of the form key.path=value or leads nowhere.
    """
    key, separator, text = override.partition("=")
    if not separator or not key:
        raise InputError(f"--set takes key.path=value, got '{override}'")
    *parents, last = key.split(".")
    node: Any = tree
    for parent in parents:
        node = _step(node, parent, override)
    value = parse_yaml(text, f"--set {override}: the value")
    if isinstance(node, list):
        node[_position(node, last, override)] = value
    else:
        node[last] = value


def _step(node: Any, key: str, override: str) -> Any:
    if isinstance(node, list):
        return node[_position(node, key, override)]
    if node.get(key) is None:
        node[key] = {}
    if not isinstance(node[key], dict | list):
        raise InputError(f"--set {override}: '{key}' holds a value, not a section")
    return node[key]


def _position(node: list[Any], key: str, override: str) -> int:
    if not (key.isascii() and key.isdigit() and len(key) < 10) or int(key) >= len(node):
        raise InputError(f"--set {override}: '{key}' is not one of the entries 0..{len(node) - 1}")
    return int(key)
