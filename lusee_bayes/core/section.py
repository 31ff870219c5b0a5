"""Common parts of all sections of a scenario: types of entries, validators, kinds."""

import os
from collections.abc import Callable, Mapping
from functools import reduce
from operator import or_
from typing import Annotated, Any, Literal, TypeVar

from docstring_parser import DocstringStyle, parse
from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, model_validator

from lusee_bayes.core.files import user_path
from lusee_bayes.core.layouts import LARGEST_MHZ, NOT_HZ

S = TypeVar("S", bound="Section")


def _not_tiny(value: float) -> float:
    if value < SMALLEST:
        raise ValueError(f"input should be at least {SMALLEST:g}")
    return value


def _not_hz(value: Any) -> Any:
    if isinstance(value, int | float) and value > LARGEST_MHZ:
        raise ValueError(NOT_HZ)
    return value


# numbers outside this range are meaningless here, and their powers overflow or underflow
SMALLEST, LARGEST = 1e-30, 1e30
NOT_TINY = AfterValidator(_not_tiny)
Positive = Annotated[float, Field(gt=0, le=LARGEST), NOT_TINY]
Temperature = Annotated[float, Field(ge=0, le=1e6)]
Angle = Annotated[float, Field(ge=-3600, le=3600)]
# seed of random numbers; below 64 bits, to leave room for one seed per channel
Seed = Annotated[int, Field(ge=0, lt=2**62)]
# a frequency in LuSEE-Night's band, in MHz
Frequency = Annotated[float, Field(ge=1, le=50), BeforeValidator(_not_hz)]
# a frequency in a file or of a spectrum
Megahertz = Annotated[Positive, BeforeValidator(_not_hz)]
# treatment of an unknown quantity
Treatment = Literal["marginalised", "sampled", "ignored"]


# entries that name files; an entry with its default value does not
FILES = (
    "clock", "file", "gain_table", "lines", "mask_file", "mean_file", "schedule", "spectrum_file",
)  # fmt: skip


def _described(schema: dict[str, Any], section: type[BaseModel]) -> None:
    """Copy the descriptions in a section's docstrings into its JSON schema."""
    for cls in reversed(section.__mro__):
        if not issubclass(cls, Section) or cls is Section:
            continue
        docstring = parse(cls.__doc__ or "", style=DocstringStyle.NUMPYDOC)
        schema["description"] = docstring.short_description
        for entry in docstring.params:
            meaning = " ".join((entry.description or "").split()).rstrip(".").replace("``", "`")
            schema["properties"][entry.arg_name]["description"] = meaning


class Section(BaseModel):
    """Part of a scenario: undeclared keys and NaN are errors, and instances are immutable.

    Types are strict: text is not a number, ``true`` is not 1, and 12.0 is not 12.
    """

    model_config = ConfigDict(
        extra="forbid", frozen=True, allow_inf_nan=False, strict=True, json_schema_extra=_described
    )

    def anchored(self: S) -> S:
        """Return a copy with absolute file names, which are valid from any folder."""
        absolute: dict[str, Any] = {}
        for name, declared in type(self).model_fields.items():
            value = getattr(self, name)
            if isinstance(value, Section):
                absolute[name] = value.anchored()
            elif isinstance(value, tuple):
                parts = (x.anchored() if isinstance(x, Section) else x for x in value)
                absolute[name] = tuple(parts)
            elif name in FILES and value is not None and value != declared.default:
                absolute[name] = os.path.abspath(value)
        return self.model_copy(update=absolute)

    @model_validator(mode="before")
    @classmethod
    def _as_sections_have_it(cls, tree: Any) -> Any:
        """Convert YAML's lists to tuples, and expand ``~`` in file names."""
        if not isinstance(tree, Mapping):
            return tree
        entries = {key: tuple(v) if isinstance(v, list) else v for key, v in tree.items()}
        names = {key: entries[key] for key in FILES if isinstance(entries.get(key), str)}
        return entries | {key: str(user_path(n)) for key, n in names.items() if n.startswith("~")}


def requires(holds: Callable[[Any], Any], message: str) -> Any:
    """A validator of a section: raises ValueError with this message unless the rule holds."""

    def checked(section: Any) -> Any:
        if not holds(section):
            raise ValueError(message)
        return section

    return model_validator(mode="after")(checked)


# the kinds of a section, by their ``model``
Kinds = Mapping[str, type[Section]]


def kinds_of(*sections: type[Section]) -> dict[str, type[Section]]:
    """Return the kinds of a section, by their ``model``."""
    return {section.model_fields["model"].default: section for section in sections}


def one_of(kinds: Kinds, complete: Callable[[dict[str, Any]], None], *, strict: bool = True) -> Any:
    """The type of a section that has several kinds.

    Entries that only its other kinds have are dropped: scenarios that were written with all keys,
    or in which ``--set`` replaces one kind by another, still contain them.

    Parameters
    ----------
    kinds : mapping
        The section of each ``model``.
    complete : callable
        Adds missing entries to the section's tree in place; without a ``model``, the first kind
        is used.
    strict : bool
        Refuse a key of another kind whose value is not that kind's default.
    """

    def completed(value: Any) -> Any:
        if not isinstance(value, dict):
            return value
        tree = dict(value)
        complete(tree)
        model = tree["model"] = tree.get("model") or next(iter(kinds))
        if not isinstance(model, str) or model not in kinds:
            return tree
        kept = {}
        for key, entry in tree.items():
            others = [k for k in kinds.values() if key in k.model_fields]
            if key in kinds[model].model_fields or not others:
                kept[key] = entry
                continue
            default = others[0].model_fields[key].get_default(call_default_factory=True)
            # YAML has lists where sections have tuples
            plain = list(default) if isinstance(default, tuple) else default
            if strict and entry not in (None, default, plain):
                names = ", ".join(name for name, kind in kinds.items() if kind in others)
                raise ValueError(f"{key} belongs to model {names}, not to {model}")
        return kept

    kind = Field(discriminator="model")
    return Annotated[reduce(or_, kinds.values()), kind, BeforeValidator(completed)]


def is_modelled(section: Any) -> bool:
    """Whether a section is present and its treatment is not ``ignored``."""
    return section is not None and section.treatment != "ignored"
