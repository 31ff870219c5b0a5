"""What results are made of: results of something else are not replaced unless that is asked for."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from lusee_bayes.core.errors import InputError
from lusee_bayes.core.files import read_manifest
from lusee_bayes.experiment.data_files import Data, digest_of, files_of, names_of_data
from lusee_bayes.experiment.scenario import Scenario

Origin = Mapping[str, str]


def origin_of(
    scenario: Scenario | None = None, data: Data | None = None, **others: object
) -> dict[str, str]:
    """What determines the numbers of a run, as text by name.

    Parameters
    ----------
    scenario : Scenario, optional
        What it says of output does not count.
    data : Visibilities, path, or sequence of them, optional
        Their content counts, not the names of files.
    **others
        Whatever else does; None for what is not there.

    Returns
    -------
    dict
        For :func:`.run_folder` and :func:`.write_run`.

    Raises
    ------
    InputError
        If there is no file of data.
    """
    found: dict[str, str] = {}
    if scenario is not None:
        tree = scenario.model_dump(mode="json", exclude={"output"})
        found |= {name: json.dumps(value) for name, value in _entries(tree)}
    if data is not None:
        names = ", ".join(f"'{Path(name).name}'" for name in names_of_data(data))
        found["data"] = f"{names} ({digest_of(data)[:12]})"
    return found | {name: str(value) for name, value in others.items() if value is not None}


def inputs_of(
    scenario: Scenario, data: Data | None = None, *others: str | Path | None
) -> list[str | Path]:
    """The files that a run reads: data, those that its scenario names, and others if given.

    For :func:`.run_folder`.
    """
    tree = scenario.model_dump(mode="json")
    named = [value for _, value in _entries(tree) if isinstance(value, str)]
    given = [] if data is None else files_of(data)
    return [*given, *filter(os.path.isfile, named), *filter(None, others)]


def _entries(tree: Mapping[str, Any], parents: str = "") -> Iterator[tuple[str, Any]]:
    for key, value in tree.items():
        if isinstance(value, Mapping):
            yield from _entries(value, f"{parents}{key}.")
        else:
            yield f"{parents}{key}", value


def require_own(folder: Path, kinds: Sequence[str], origin: Origin) -> None:
    """Check that a folder holds no results of another run.

    Parameters
    ----------
    folder : Path
    kinds : sequence of str
        Of the run that is to write there, and of those whose results it goes on from.
    origin : mapping
        What it is made of.

    Raises
    ------
    InputError
        If it does; the first difference is named.
    """
    manifest = read_manifest(folder)
    if manifest is None:
        return
    there, advice = manifest["origin"], "give another folder with -o, or --force to replace them"
    if manifest["kind"] not in kinds:
        raise InputError(f"'{folder}' holds results of lusee-bayes {manifest['kind']}; {advice}")
    for name in [*origin, *there]:
        old, new = there.get(name), origin.get(name)
        if old != new:
            old, new = (_short(value) for value in (old, new))
            raise InputError(
                f"'{folder}' holds results of another run: {name} is {old} there and {new} here; "
                f"{advice}"
            )


def _short(value: str | None) -> str:
    if value is None:
        return "not given"
    return value if len(value) <= 60 else f"{value[:57]}..."
