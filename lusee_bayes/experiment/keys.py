"""Every key of a scenario: meaning, unit, choices and default, as the schema has them.

Meanings are the ``Attributes`` of the sections' docstrings, units the endings of names, choices the
fields' types.
"""

from __future__ import annotations

import types
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from docstring_parser import DocstringStyle, parse
from pydantic.fields import FieldInfo
from pydantic_core import PydanticUndefined

from lusee_bayes.core.errors import InputError, nearest
from lusee_bayes.core.reading import as_yaml
from lusee_bayes.core.section import Section
from lusee_bayes.experiment.scenario import Scenario

UNITS = {
    "mhz": "MHz",
    "hz": "Hz",
    "deg": "degrees",
    "m": "m",
    "s": "s",
    "day": "s/day",
    "h": "h",
    "k": "K",
    "jy": "Jy",
    "pf": "pF",
    "nh": "nH",
    "ohm": "Ohm",
}
TYPES = {float: "number", int: "integer", str: "text", bool: "true, false"}
# annotated-types' names of bounds, as they are written
BOUNDS = {"gt": ">", "ge": ">=", "lt": "<", "le": "<="}
# bounds that only keep numbers within what floats and seeds can hold
WIDEST = 1e18


@dataclass(frozen=True)
class Key:
    """A key of a scenario.

    Attributes
    ----------
    path : str
        With the sections that it is in, as ``--set`` takes it.
    kind : str
        The ``model`` that has it, where a section has several kinds; else empty.
    unit : str
        Empty for what has none.
    choices : str
        Type, bounds or list of values.
    default : str
        As in YAML.
    meaning : str
        In words.
    """

    path: str
    kind: str
    unit: str
    choices: str
    default: str
    meaning: str


def scenario_keys(within: str = "") -> list[Key]:
    """List the keys of a scenario in the order of the schema.

    Parameters
    ----------
    within : str
        Only this key, or those of this section.

    Raises
    ------
    InputError
        If there is no such key.
    """
    keys = list(_keys_of(Scenario, "", ""))
    if not within:
        return keys
    found = [k for k in keys if k.path == within or k.path.startswith(f"{within}.")]
    if not found:
        known = {k.path.rsplit(".", n)[0] for k in keys for n in range(k.path.count(".") + 1)}
        raise InputError(f"a scenario has no key '{within}'; {nearest(within, sorted(known))}")
    return found


def keys_as_markdown(keys: Iterable[Key]) -> str:
    """Write keys as a table, with | escaped."""
    lines = ["| key | model | meaning | unit | choices | default |", "| --- " * 6 + "|"]
    for key in keys:
        cells = (f"`{key.path}`", key.kind, key.meaning, key.unit, key.choices, f"`{key.default}`")
        lines.append(f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in cells)} |")
    return "\n".join(lines) + "\n"


def _keys_of(section: type[Section], prefix: str, kind: str) -> Iterator[Key]:
    meanings = _meanings(section)
    for name, field in section.model_fields.items():
        path = f"{prefix}{name}"
        inner = list(_sections(field.annotation))
        if kind and name == "model":
            continue
        if not inner:
            yield Key(
                path,
                kind,
                _unit(name),
                _choices(field.annotation, field.metadata),
                _as_yaml(field.get_default(call_default_factory=True)),
                meanings.get(name, f"Kind of {prefix.rstrip('.')}" if name == "model" else ""),
            )
        elif field.default is None or _is_sequence(field.annotation):
            choices = "list of sections" if _is_sequence(field.annotation) else "a section"
            yield Key(path, kind, "", choices, _as_yaml(field.default), meanings.get(name, ""))
        if len(inner) > 1:
            kinds = [str(one.model_fields["model"].default) for one in inner]
            meaning = f"Kind of {name}, on which the keys below depend"
            first = "none" if field.default is None else kinds[0]
            yield Key(f"{path}.model", kind, "", ", ".join(kinds), first, meaning)
        for one in inner:
            several = str(one.model_fields["model"].default) if len(inner) > 1 else ""
            number = ".0" if _is_sequence(field.annotation) else ""
            yield from _keys_of(one, f"{path}{number}.", several)


def _meanings(section: type[Section]) -> dict[str, str]:
    """By name; of sections that it does not describe, what they say of themselves."""
    found = {
        name: parse(inner.__doc__ or "").short_description
        for name, field in section.model_fields.items()
        for inner in _sections(field.annotation)
    }
    for cls in reversed(section.__mro__):
        parsed = parse(cls.__doc__ or "", style=DocstringStyle.NUMPYDOC)
        found |= {p.arg_name: p.description for p in parsed.params}
    return {
        name: " ".join((text or "").split()).rstrip(".").replace("``", "`")
        for name, text in found.items()
    }


def _without_metadata(annotation: Any) -> tuple[Any, tuple[Any, ...]]:
    if get_origin(annotation) is Annotated:
        inner, *metadata = get_args(annotation)
        return inner, tuple(metadata)
    return annotation, ()


def _alternatives(annotation: Any) -> tuple[Any, ...]:
    """The parts of a union, None left out."""
    bare = _without_metadata(annotation)[0]
    if get_origin(bare) in (Union, types.UnionType):
        return tuple(b for a in get_args(bare) if a is not type(None) for b in _alternatives(a))
    return (annotation,)


def _sections(annotation: Any) -> Iterator[type[Section]]:
    for one in _alternatives(annotation):
        bare = _without_metadata(one)[0]
        if isinstance(bare, type) and issubclass(bare, Section):
            yield bare
        elif _is_sequence(one):
            yield from _sections(get_args(bare)[0])


def _is_sequence(annotation: Any) -> bool:
    return get_origin(_without_metadata(annotation)[0]) is tuple


def _unit(name: str) -> str:
    if name.endswith("_v2_hz"):
        return "V²/Hz"
    return UNITS.get(name.rsplit("_", 1)[-1], "") if "_" in name else ""


def _choices(annotation: Any, metadata: Iterable[Any] = ()) -> str:
    (one,) = _alternatives(annotation)
    bare, own = _without_metadata(one)
    if get_origin(bare) is Literal:
        return ", ".join(str(value) for value in get_args(bare))
    if get_origin(bare) is tuple:
        return f"list of: {_choices(get_args(bare)[0])}"
    if get_origin(bare) is dict:
        return f"name: {_choices(get_args(bare)[1])}"
    bounds = dict(_bounds([*metadata, *own]))
    if "ge" in bounds and "le" in bounds:
        return f"{TYPES[bare]}, {bounds['ge']} to {bounds['le']}"
    return ", ".join([TYPES[bare], *(f"{BOUNDS[name]} {at}" for name, at in bounds.items())])


def _bounds(metadata: Iterable[Any]) -> Iterator[tuple[str, str]]:
    for item in metadata:
        if isinstance(item, FieldInfo):
            yield from _bounds(item.metadata)
        for name in BOUNDS:
            limit = getattr(item, name, None)
            if limit is not None and abs(limit) < WIDEST:
                yield name, f"{limit:g}"


def _as_yaml(value: Any) -> str:
    if value is PydanticUndefined:
        return "required"
    if value is None:
        return "none"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, Section):
        return as_yaml(value.model_dump(), flow=True).strip()
    if isinstance(value, tuple):
        return f"[{', '.join(_as_yaml(item) for item in value)}]"
    return "{}" if value == {} else str(value)
