"""Schedules in files: tables of intervals in CSV, and command tables of LuSEE-Night's OpSim.

OpSim (https://github.com/lusee-night/opsim) has its schedules in YAML: ``config/comtable-*.yml``,
and the same with the states of battery and storage in the logs of its simulator. An entry holds a
``start`` (MJD, UTC) and a ``mode`` of the spacecraft, which lasts until the start of the next
entry. In one mode alone, ``science``, the spectrometer takes data (``config/modes.yml`` and
``devices.yml`` there). Such a table knows of no turntable.
"""

from __future__ import annotations

from functools import lru_cache
from io import StringIO
from itertools import pairwise
from pathlib import Path

import numpy as np
from astropy.time import Time

from lusee_bayes.core.errors import InputError
from lusee_bayes.core.lazy import pandas
from lusee_bayes.core.reading import naming, parse_yaml, read_text, reading
from lusee_bayes.instrument.schedule import Interval, require_sequence
from lusee_bayes.instrument.times import require_ephemeris, unannounced_leap_seconds

WHAT = "a schedule, a table in CSV or OpSim's in YAML"
REQUIRED = {"start", "end", "turntable_deg"}
OPTIONAL = {"duty_cycle", "night_only"}
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
        With file and row, for a missing column, a bad value, intervals that overlap or are not in
        order, and a schedule without any.
    """
    return _parsed(str(path), read_text(path, WHAT))


@lru_cache(maxsize=4)
def _parsed(path: str, text: str) -> tuple[Interval, ...]:
    """Channels of several frequencies and estimates of their cost read the same file again."""
    is_yaml = Path(path).suffix in (".yaml", ".yml")
    intervals = _of_commands(path, text) if is_yaml else _of_table(path, text)
    with naming(path):
        require_sequence(intervals)
    return intervals


def _of_table(path: str, text: str) -> tuple[Interval, ...]:
    with reading(path, WHAT):
        table = pandas.read_csv(StringIO(text), dtype=str, comment="#", skipinitialspace=True)
        if not isinstance(table.index, pandas.RangeIndex):
            raise ValueError("rows have more entries than the header")
    table = table.fillna("")
    if not REQUIRED <= set(table.columns) <= REQUIRED | OPTIONAL:
        raise InputError(
            f"{path} has the columns {', '.join(table.columns)}; a schedule has "
            f"{', '.join(sorted(REQUIRED))}, and may have {' and '.join(sorted(OPTIONAL))}"
        )
    return tuple(
        _interval(f"{path}, row {number}", row)
        for number, row in enumerate(table.to_dict("records"), start=1)
    )


def _interval(place: str, row: dict[str, str]) -> Interval:
    numbers = {}
    for name, default in (("turntable_deg", ""), ("duty_cycle", "1")):
        try:
            numbers[name] = float(row.get(name) or default)
        except ValueError as error:
            raise InputError(f"{place}: {name} is '{row[name]}', not a number") from error
    night_only = (row.get("night_only", "").strip() or "false").lower()
    if night_only not in ("true", "false"):
        raise InputError(f"{place}: night_only is '{night_only}'; write true or false")
    return Interval(
        row["start"], row["end"], **numbers, night_only=night_only == "true", where=place
    )


def _of_commands(path: str, text: str) -> tuple[Interval, ...]:
    """Every stretch in the mode science."""
    root = parse_yaml(text, path)
    if not isinstance(root, dict):
        raise InputError(
            f"{path} is no command table of OpSim: expected numbered entries with start and mode; "
            "a table of intervals is a CSV file, whose name ends otherwise"
        )
    entries = [_command(f"{path}, entry {name}", entry) for name, entry in root.items()]
    for (_, before, _), (place, after, _) in pairwise(entries):
        if not after > before:
            raise InputError(
                f"{place}: start {after} does not come after that of the entry before, {before}; "
                "sort the entries by their start"
            )
    if entries and entries[-1][2] == OBSERVING:
        raise InputError(
            f"{entries[-1][0]}: the last entry is in the mode {OBSERVING}, and nothing says when "
            "it ends; add an entry of another mode"
        )
    return tuple(
        Interval(_date(start), _date(end), where=place)
        for (place, start, mode), (_, end, _) in pairwise(entries)
        if mode == OBSERVING
    )


def _command(place: str, entry: object) -> tuple[str, float, str]:
    """Where an entry is, its start as MJD and its mode."""
    try:
        start, mode = float(entry["start"]), str(entry["mode"])  # type: ignore[index]
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(
            f"{place}: a command table of OpSim has a start (a modified Julian date, UTC, as "
            "61050.8) and a mode in each entry"
        ) from error
    with naming(place):
        require_ephemeris(np.array([start + 2400000.5]))
    return place, start, mode


def _date(mjd: float) -> str:
    """To the microsecond, which is all that a double holds of it."""
    with unannounced_leap_seconds():
        return str(Time(mjd, format="mjd", scale="utc", precision=6).isot)
