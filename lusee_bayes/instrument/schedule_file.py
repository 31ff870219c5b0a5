"""Schedules in files: tables of intervals in CSV, and command tables of LuSEE-Night's OpSim.

OpSim (https://github.com/lusee-night/opsim) has its schedules in YAML: ``config/comtable-*.yml``,
and the same with the states of battery and storage in the logs of its simulator. An entry holds a
``start`` (MJD, UTC) and a ``mode`` of the spacecraft, which lasts until the start of the next
entry. In one mode alone, ``science``, the spectrometer takes data (``config/modes.yml`` and
``devices.yml`` there). Such a table knows of no turntable.
"""

from __future__ import annotations

import csv
from collections.abc import Iterator, Sequence
from functools import lru_cache
from itertools import pairwise
from pathlib import Path

import numpy as np
import yaml
from astropy.time import Time

from lusee_bayes.core.errors import InputError, nearest
from lusee_bayes.core.reading import naming, read_text, reading
from lusee_bayes.instrument.schedule import Interval, require_sequence
from lusee_bayes.instrument.times import require_ephemeris, unannounced_leap_seconds

WHAT = "a schedule, a table in CSV or OpSim's in YAML"
REQUIRED = ("start", "end", "turntable_deg")
OPTIONAL = ("duty_cycle", "night_only")
# of OpSim, in which data are taken
OBSERVING = "science"


def read_schedule(path: str | Path) -> tuple[Interval, ...]:
    """Read the intervals of a schedule.

    Parameters
    ----------
    path : str or Path
        CSV with the columns ``start``, ``end`` (UTC, ISO) and ``turntable_deg``, and, if they are
        wanted, ``duty_cycle`` and ``night_only`` (true or false); what follows a # is a comment.
        Or, if the name ends in .yaml or .yml, a command table of OpSim, whose intervals in the
        mode ``science`` are taken, with the turntable at zero.

    Returns
    -------
    tuple of Interval
        In order.

    Raises
    ------
    InputError
        With file and line, for a missing column, a bad value, intervals that overlap or are not in
        order, and a schedule without any.
    """
    return _parsed(str(path), read_text(path, WHAT))


@lru_cache(maxsize=4)
def _parsed(path: str, text: str) -> tuple[Interval, ...]:
    """Channels of several frequencies and estimates of their cost read the same file again."""
    is_yaml = Path(path).suffix in (".yaml", ".yml")
    intervals = tuple(_of_commands(path, text) if is_yaml else _of_table(path, text))
    if not intervals:
        raise InputError(f"{path} holds no interval below its header; give at least one")
    require_sequence(intervals)
    return intervals


def _of_table(path: str, text: str) -> Iterator[Interval]:
    lines = [line.partition("#")[0] for line in text.splitlines()]
    with reading(path, WHAT):
        rows = [
            (f"{path}, line {number}", [cell.strip() for cell in next(csv.reader([line]))])
            for number, line in enumerate(lines, start=1)
            if line.strip()
        ]
    if not rows:
        raise InputError(f"{path} is empty; give a table with the header {','.join(REQUIRED)}")
    place, header = rows[0]
    _check_header(place, header)
    for place, row in rows[1:]:
        if len(row) != len(header):
            raise InputError(
                f"{place}: there are {len(row)} entries for the {len(header)} columns "
                f"{','.join(header)}; give each column one"
            )
        cells = dict(zip(header, row, strict=True))
        yield Interval(
            cells["start"],
            cells["end"],
            _number(place, cells, "turntable_deg"),
            _number(place, cells, "duty_cycle") if cells.get("duty_cycle") else 1.0,
            _truth(place, cells.get("night_only") or "false"),
            place,
        )


def _check_header(place: str, header: Sequence[str]) -> None:
    known = (*REQUIRED, *OPTIONAL)
    for name in REQUIRED:
        if name not in header:
            raise InputError(
                f"{place}: there is no column '{name}' in the header {','.join(header)}; a "
                f"schedule has {', '.join(REQUIRED)}, and may have {' and '.join(OPTIONAL)}"
            )
    for name in header:
        if name not in known:
            raise InputError(
                f"{place}: a schedule has no column '{name}'; {nearest(name, sorted(known))}"
            )
        if header.count(name) > 1:
            raise InputError(f"{place}: the column '{name}' comes twice; leave out one of them")


def _number(place: str, cells: dict[str, str], name: str) -> float:
    try:
        return float(cells[name])
    except ValueError as error:
        raise InputError(
            f"{place}: {name} is '{cells[name]}', not a number; write it as 0.5 or -30"
        ) from error


def _truth(place: str, text: str) -> bool:
    if text.lower() not in ("true", "false"):
        raise InputError(f"{place}: night_only is '{text}'; write true or false")
    return text.lower() == "true"


def _of_commands(path: str, text: str) -> Iterator[Interval]:
    """Every stretch in the mode science."""
    with reading(path, WHAT):
        # numbers stay text: OpSim's keys are numbers, and lines are needed for messages
        root = yaml.compose(text, Loader=yaml.BaseLoader)
    if not isinstance(root, yaml.MappingNode):
        raise InputError(
            f"{path} is no command table of OpSim: expected numbered entries with start and mode; "
            "a table of intervals is a CSV file, whose name ends otherwise"
        )
    entries = [
        _command(f"{path}, line {key.start_mark.line + 1}", node) for key, node in root.value
    ]
    for (_, before, _), (place, after, _) in pairwise(entries):
        if not after > before:
            raise InputError(
                f"{place}: start {after} does not come after that of the entry before, {before}; "
                "sort the entries by their start"
            )
    if OBSERVING not in {mode for _, _, mode in entries}:
        raise InputError(
            f"{path} holds no entry in the mode {OBSERVING}, the one in which data are taken; its "
            f"modes are {', '.join(sorted({mode for _, _, mode in entries}))}"
        )
    if entries[-1][2] == OBSERVING:
        raise InputError(
            f"{entries[-1][0]}: the last entry is in the mode {OBSERVING}, and nothing says when "
            "it ends; add an entry of another mode"
        )
    for (place, start, mode), (_, end, _) in pairwise(entries):
        if mode == OBSERVING:
            yield Interval(_date(start), _date(end), where=place)


def _command(place: str, node: yaml.Node) -> tuple[str, float, str]:
    """Where an entry is, its start as MJD and its mode."""
    found = {}
    if isinstance(node, yaml.MappingNode):
        found = {key.value: value.value for key, value in node.value}
    for name in ("start", "mode"):
        if not isinstance(found.get(name), str):
            raise InputError(
                f"{place}: the entry has no {name}; a command table of OpSim has a start (MJD, "
                "UTC) and a mode in each"
            )
    try:
        start = float(found["start"])
    except ValueError as error:
        raise InputError(
            f"{place}: start is '{found['start']}', not a number; give a modified Julian date, as "
            "61050.8"
        ) from error
    with naming(place):
        require_ephemeris(np.array([start + 2400000.5]))
    return place, start, found["mode"]


def _date(mjd: float) -> str:
    """To the microsecond, which is all that a double holds of it."""
    with unannounced_leap_seconds():
        return str(Time(mjd, format="mjd", scale="utc", precision=6).isot)
