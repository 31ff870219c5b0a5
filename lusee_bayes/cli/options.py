"""Options that commands share, and the tables that they print.

What commands have in common: options that mean the same everywhere.

The tables that commands print.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from itertools import pairwise
from math import inf, isclose
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter, Token
from rich.console import Console
from rich.table import Table

from lusee_bayes.core.errors import InputError

if TYPE_CHECKING:
    from lusee_bayes.experiment.scenario import Scenario


Overrides = Annotated[list[str], Parameter(name="--set", negative="")]
Quiet = Annotated[
    bool, Parameter(name=["--quiet", "-q"], negative="", help="Print nothing but errors.")
]
# 10,25 or 5:50:5
Frequencies = Annotated[str | None, Parameter(name="--frequencies")]
Verbose = Annotated[
    bool,
    Parameter(
        name=["--verbose", "-v"],
        negative="",
        help="Print the memory in use after every stage.",
    ),
]


def _whole(least: int) -> Callable[[object, Sequence[Token]], int]:
    """A converter for whole numbers of at least ``least``: no fractions, no other digits."""

    def convert(_: object, tokens: Sequence[Token]) -> int:
        token = tokens[0]
        text = token.value
        plain = text.removeprefix("-")
        if not (plain.isascii() and plain.isdigit() and len(plain) < 10) or int(text) < least:
            raise InputError(f"expected a whole number from {least} to 999999999, got {text[:40]}")
        return int(text)

    return convert


# so many of something: none of them is possible, or at least one
Number = Annotated[int, Parameter(converter=_whole(0))]
Count = Annotated[int, Parameter(converter=_whole(1))]
# what carries out the tasks of a run
Workers = Annotated[int | None, Parameter(name="--workers", converter=_whole(1))]
Cluster = Annotated[str | None, Parameter(name="--cluster")]
Flag = Annotated[bool, Parameter(negative="")]
# one file of visibilities, or sessions of the spectrometer
DataFiles = Annotated[
    tuple[Path, ...] | None, Parameter(name="--data", consume_multiple=True, negative="")
]
Clock = Annotated[
    str | None,
    Parameter(
        name="--clock",
        help="Clock reference in JSON, for sessions with no absolute time, or to correct the UTC "
        "that they state (flight.clock).",
    ),
]
Output = Annotated[Path | None, Parameter(name=["--output", "-o"])]
# to replace the results of a run, or a file
Force = Annotated[
    bool,
    Parameter(name="--force", negative="", help="Replace results of another run in the folder."),
]
ForceFile = Annotated[
    bool, Parameter(name="--force", negative="", help="Replace what is there already.")
]


# a number and its unit
DURATION = re.compile(r"\s*([0-9]*\.?[0-9]+(?:e[+-]?[0-9]+)?)\s*(s|min|h|d)\s*", re.ASCII)
SECONDS = {"s": 1.0, "min": 60.0, "h": 3600.0, "d": 86400.0}


# channels of one run: far more than 25 kHz apart over the band
MOST_CHANNELS = 4096


def load(
    source: str,
    set_: list[str] | None,
    frequencies: str | None = None,
    replaces: Path | None = None,
    **flags: str | int | bool | None,
) -> Scenario:
    """The scenario of a command, with its ``--set`` and with what options say of it.

    Parameters
    ----------
    source : str
        A YAML file or the name of a scenario.
    set_ : list of str
        ``key.path=value``.
    frequencies : str
        See :func:`parse_frequencies`.
    replaces : Path
        A folder or file that is to be replaced: not where the scenario is in it.
    **flags
        Values of entries, dots written as ``__``; those that are None or False are left alone.

    Raises
    ------
    InputError
        As :func:`.load_scenario`, and as :func:`.require_apart`.
    """
    from lusee_bayes.core.files import require_apart
    from lusee_bayes.experiment.scenario import load_scenario

    if replaces is not None:
        require_apart(replaces, [source])
    overrides = list(set_ or [])
    if frequencies is not None:
        overrides.append(f"frequencies_mhz={parse_frequencies(frequencies)}")
    for name, value in flags.items():
        if value is not None and value is not False:
            overrides.append(f"{name.replace('__', '.')}={str(value).lower()}")
    return load_scenario(source, overrides)


def default_folder(source: str, suffix: str = "") -> Path:
    """Where the results of a scenario go that are not told where."""
    return Path("output") / f"{Path(source).stem}{suffix}"


def say(console: Console, *lines: object) -> None:
    """Print lines as they are."""
    for line in lines:
        console.print(str(line), highlight=False, markup=False)


def show(console: Console, table: Table) -> None:
    """Print a table within the width of the terminal: its cells are wrapped."""
    console.print(table, soft_wrap=False)


def parse_duration(text: str) -> float:
    """Seconds out of ``30s``, ``10min``, ``2h`` or ``1d``. InputError if it is none of these."""
    found = DURATION.fullmatch(text)
    seconds = float(found[1]) * SECONDS[found[2]] if found else 0.0
    if not 0.0 < seconds < inf:
        raise InputError(
            f"'{text[:40]}' is not a length of time; give a positive number and its unit, s, min, "
            "h or d, as in 30s, 10min, 2h or 1d"
        )
    return seconds


def parse_frequencies(text: str) -> list[float]:
    """MHz out of ``10,25,30`` or of ``first:last:step``, the last included.

    InputError if it is neither.
    """
    try:
        if ":" not in text:
            found = [float(part) for part in text.split(",")]
        else:
            first, last, step = (float(part) for part in text.split(":"))
            count = round((last - first) / step)
            if count >= MOST_CHANNELS:
                raise InputError(
                    f"--frequencies {text}: {count + 1} channels; at most {MOST_CHANNELS} are "
                    "possible in one run"
                )
            found = [first + k * step for k in range(count + 1)]
            if not step > 0 or not (found and isclose(found[-1], last, rel_tol=1e-5, abs_tol=1e-8)):
                raise ValueError
    except InputError:
        raise
    except (ValueError, ZeroDivisionError, OverflowError):
        found = []
    if not found or any(b <= a for a, b in pairwise(found)):
        raise InputError(
            f"--frequencies {text}: expected growing MHz, as 10,25,30 or as 5:50:5 (first, last, "
            "step)"
        )
    return found
