"""What is wrong with a scenario, in one sentence."""

from __future__ import annotations

from typing import Any, get_args

from pydantic import BaseModel, ValidationError

from lusee_bayes.core.errors import nearest


def one_sentence(error: ValidationError, source: str, model: type[BaseModel]) -> str:
    """What was found, what was expected and where, for the first thing that is wrong.

    Parameters
    ----------
    error : ValidationError
        Of pydantic.
    source : str
        Where the scenario comes from.
    model : type
        The model that it was validated against.
    """
    first = error.errors()[0]
    path, sections = _resolved(first["loc"], model)
    where = ".".join(path)
    if first["type"] == "extra_forbidden":
        known = {name for section in sections for name in section.model_fields}
        return f"{source}: unknown key '{where}'; {nearest(path[-1], known)}"
    more = f" (and {error.error_count() - 1} more)" if error.error_count() > 1 else ""
    if first["type"] == "union_tag_invalid":
        models = first["ctx"]["expected_tags"].replace("'", "").split(", ")
        got = first["ctx"]["tag"]
        return f"{source}: {where}.model is '{got}', which is unknown; {nearest(got, models)}{more}"
    if first["type"] == "missing":
        return f"{source}: {where} is missing{more}"
    expected = first["msg"].removeprefix("Value error, ")
    expected = expected[0].lower() + expected[1:]
    if first["type"] == "value_error" and isinstance(first["input"], (dict, BaseModel)):
        return f"{source}: {where}: {expected}{more}" if where else f"{source}: {expected}{more}"
    if first["type"] in ("model_type", "model_attributes_type", "dict_type"):
        # pydantic names the class
        expected = "it should be a section with keys; lusee-bayes keys lists them"
    # YAML has lists where sections have tuples
    got = list(first["input"]) if isinstance(first["input"], tuple) else first["input"]
    return f"{source}: {where} is {got!r}, but {expected}{more}"


def _resolved(
    location: tuple[int | str, ...], model: type[BaseModel]
) -> tuple[list[str], list[type[BaseModel]]]:
    """The path as a user writes it, and the section that its last key belongs to, of every kind.

    pydantic puts the ``model`` of a section that comes in several kinds into the path. A key may be
    meant for another kind than the one that was found: ``sky.fil=X`` is taken for a galaxy's.
    """
    path: list[str] = []
    section: type[BaseModel] | None = model
    sections = [model]
    kinds: dict[str, type[BaseModel]] = {}
    for number, key in enumerate(location):
        if key in kinds:
            section, kinds = kinds[str(key)], {}
            continue
        path.append(str(key))
        if isinstance(key, int) or section is None or number == len(location) - 1:
            continue
        field = section.model_fields.get(key)
        found = [] if field is None else _models_in(field.annotation)
        kinds = {str(m.model_fields["model"].default): m for m in found if len(found) > 1}
        section, sections = (found[0] if len(found) == 1 else None), found
    return path, sections


def _models_in(annotation: Any) -> list[type[BaseModel]]:
    """Every section that a field's type names."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [model for part in get_args(annotation) for model in _models_in(part)]
