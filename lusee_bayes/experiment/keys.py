"""Every key of a scenario: meaning, unit, choices and default, from its JSON schema.

Units follow from the endings of names. Everything else is in ``Scenario.model_json_schema()``,
which YAML editors also read.
"""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from lusee_bayes.core.errors import require_known
from lusee_bayes.core.reading import as_yaml
from lusee_bayes.experiment.scenario import Scenario

SAME = ("MHz", "Hz", "m", "s", "h", "K", "Jy", "pF", "nH", "Ohm")
UNITS = {unit.lower(): unit for unit in SAME} | {"deg": "degrees", "day": "s/day"}
TYPES = {"number": "number", "integer": "integer", "string": "text", "boolean": "true, false"}
# notation for the bounds in a JSON schema
BOUNDS = {"exclusiveMinimum": ">", "minimum": ">=", "exclusiveMaximum": "<", "maximum": "<="}
# larger bounds only keep numbers within the range of floats and seeds, and are not listed
WIDEST = 1e18

Schema = Mapping[str, Any]


@dataclass(frozen=True)
class Key:
    """A key of a scenario.

    Attributes
    ----------
    path : str
        With its sections, as in ``--set``.
    kind : str
        The ``model`` that has the key if a section has several kinds; else empty.
    unit : str
        Empty if the key has none.
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

    def __str__(self) -> str:
        model = f"  (model {self.kind})" if self.kind else ""
        unit = f" [{self.unit}]" if self.unit else ""
        return f"{self.path} = {self.default}{model}\n    {self.meaning}\n    {self.choices}{unit}"


def scenario_keys(within: str = "") -> list[Key]:
    """List the keys of a scenario in the order of the schema.

    Parameters
    ----------
    within : str
        List only this key, or the keys of this section.

    Raises
    ------
    InputError
        If there is no such key.
    """
    schema = Scenario.model_json_schema()
    keys = list(_keys_of(schema, schema["$defs"], "", ""))
    if not within:
        return keys
    paths = {k.path.rsplit(".", n)[0] for k in keys for n in range(k.path.count(".") + 1)}
    require_known("a scenario has no key", within, sorted(paths))
    return [k for k in keys if k.path == within or k.path.startswith(f"{within}.")]


def keys_as_markdown(keys: Iterable[Key]) -> str:
    """Write keys as a table, with | escaped."""
    lines = ["| key | model | meaning | unit | choices | default |", "| --- " * 6 + "|"]
    for key in keys:
        cells = (f"`{key.path}`", key.kind, key.meaning, key.unit, key.choices, f"`{key.default}`")
        lines.append(f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in cells)} |")
    return "\n".join(lines) + "\n"


def _keys_of(section: Schema, sections: Schema, prefix: str, kind: str) -> Iterator[Key]:
    for name, entry in section["properties"].items():
        if kind and name == "model":
            continue
        path, meaning = f"{prefix}{name}", entry.get("description", "")
        inner = [sections[reference] for reference in _references(entry)]
        # an entry without a description has that of its section
        if not meaning and len(inner) == 1:
            meaning = str(inner[0].get("description", "")).rstrip(".").replace("``", "`")
        default = "required" if name in section.get("required", ()) else _default(entry)
        is_list = entry.get("type") == "array"
        if not inner:
            meaning = meaning or (f"Kind of {prefix.rstrip('.')}" if name == "model" else "")
            yield Key(path, kind, _unit(name), _choices(entry), default, meaning)
        elif is_list or default == "none":
            choices = "list of sections" if is_list else "a section"
            yield Key(path, kind, "", choices, default, meaning)
        kinds = [one["properties"]["model"]["const"] for one in inner] if len(inner) > 1 else [""]
        if len(inner) > 1:
            first = "none" if default == "none" else kinds[0]
            meaning = f"Kind of {name}, on which the keys below depend"
            yield Key(f"{path}.model", kind, "", ", ".join(kinds), first, meaning)
        for one, its_kind in zip(inner, kinds, strict=False):
            yield from _keys_of(one, sections, f"{path}{'.0' * is_list}.", its_kind)


def _alternatives(entry: Schema) -> list[Schema]:
    """Schemas that an entry allows, except null."""
    return [one for one in entry.get("anyOf", [entry]) if one.get("type") != "null"]


def _references(entry: Schema) -> Iterator[str]:
    """Names of the sections that an entry, or an item of its list, may be."""
    for one in _alternatives(entry):
        for kind in one.get("oneOf", [one.get("items", one)]):
            if "$ref" in kind:
                yield kind["$ref"].rpartition("/")[2]


def _unit(name: str) -> str:
    if name.endswith("_v2_hz"):
        return "V²/Hz"
    return UNITS.get(name.rsplit("_", 1)[-1], "") if "_" in name else ""


def _choices(entry: Schema) -> str:
    (one,) = _alternatives(entry)
    if "enum" in one:
        return ", ".join(map(str, one["enum"]))
    if one["type"] == "array":
        return f"list of: {_choices(one['items'] if 'items' in one else one['prefixItems'][0])}"
    if one["type"] == "object":
        return f"name: {_choices(one['additionalProperties'])}"
    bounds = {key: f"{one[key]:g}" for key in BOUNDS if abs(one.get(key, WIDEST)) < WIDEST}
    if bounds.keys() == {"minimum", "maximum"}:
        return f"{TYPES[one['type']]}, {bounds['minimum']} to {bounds['maximum']}"
    return ", ".join([TYPES[one["type"]], *(f"{BOUNDS[key]} {at}" for key, at in bounds.items())])


def _default(entry: Schema) -> str:
    """Format the default as in YAML; a default from a factory, as for a mapping, is empty."""
    value = entry.get("default", {})
    if value is None or isinstance(value, str):
        return value or "none"
    return as_yaml(value, flow=True).removesuffix("\n...\n").strip()
