"""YAML as scenarios use it: plain values in lists and mappings, nothing that could be misread.

Numbers are decimal, ``1e6`` among them; dates stay text; a key that comes twice, anchors and
aliases are errors. (YAML 1.1 takes ``1e6`` for text, ``010`` for eight, ``1:30`` for ninety, and of
a key that comes twice the last value.)
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import yaml

from lusee_bayes.core.errors import InputError
from lusee_bayes.core.reading import read_text

# lists and mappings within each other
DEEPEST = 30
INTEGER = re.compile(r"^[-+]?[0-9]{1,300}$")
REAL = re.compile(
    r"^([-+]?([0-9]{1,300}\.[0-9]{0,300}|\.[0-9]{1,300}|[0-9]{1,300}(?=[eE]))([eE][-+]?[0-9]{1,5})?"
    r"|[-+]?\.(inf|Inf|INF)|\.(nan|NaN|NAN))$"
)


class _Loader(yaml.SafeLoader):
    """PyYAML's safe loader without what is misread easily."""

    depth = 0

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node:
        """Refuse aliases, and what is nested too deeply."""
        if self.check_event(yaml.AliasEvent):
            mark = self.peek_event().start_mark
            raise yaml.composer.ComposerError(None, None, "aliases are not supported", mark)
        self.depth += 1
        if self.depth > DEEPEST:
            mark = self.peek_event().start_mark
            words = f"lists and keys are nested more than {DEEPEST} deep"
            raise yaml.composer.ComposerError(None, None, words, mark)
        node = super().compose_node(parent, index)
        self.depth -= 1
        return node

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        """Refuse keys that come twice, and those that are no text."""
        known: set[str] = set()
        for key, _ in node.value:
            if not isinstance(key, yaml.ScalarNode) or key.tag != "tag:yaml.org,2002:str":
                raise yaml.constructor.ConstructorError(
                    None, None, "a key is no text", key.start_mark
                )
            if key.value in known:
                raise yaml.constructor.ConstructorError(
                    None, None, f"the key '{key.value}' comes twice", key.start_mark
                )
            known.add(key.value)
        return super().construct_mapping(node, deep)


_Loader.yaml_implicit_resolvers = {
    letter: [
        (tag, pattern)
        for tag, pattern in resolvers
        if tag.rsplit(":", 1)[1] not in ("int", "float", "timestamp", "merge")
    ]
    for letter, resolvers in yaml.SafeLoader.yaml_implicit_resolvers.items()
}
_Loader.add_implicit_resolver("tag:yaml.org,2002:int", INTEGER, list("-+0123456789"))
_Loader.add_implicit_resolver("tag:yaml.org,2002:float", REAL, list("-+0123456789."))
_Loader.add_constructor(
    "tag:yaml.org,2002:int", lambda loader, node: int(loader.construct_scalar(node))
)


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
        Lists, mappings with text as keys, numbers, text, booleans and None.

    Raises
    ------
    InputError
        If it is not valid, or holds something that could be misread.
    """
    try:
        return yaml.load(text, Loader=_Loader)
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise InputError(f"{where} is not valid YAML: {_in_a_line(error)}") from error


def read_yaml(path: str | Path, what: str, hint: str = "") -> Any:
    """Read a YAML file. InputError if it cannot be read, or as :func:`parse_yaml`."""
    return parse_yaml(read_text(path, what, hint), str(path))


def _in_a_line(error: Exception) -> str:
    mark, problem = getattr(error, "problem_mark", None), getattr(error, "problem", None)
    if problem is None:
        return " ".join(str(error).split())
    return problem if mark is None else f"{problem} (line {mark.line + 1})"
