"""What commands share: options that mean the same everywhere, and how a command prints."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from itertools import pairwise
from math import inf, isclose
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter, Token
from rich.console import Console
from rich.table import Table

from lusee_bayes.core.errors import InputError
from lusee_bayes.core.progress import Stages

if TYPE_CHECKING:
    from lusee_bayes.core.engine import Demand, Engine
    from lusee_bayes.experiment.scenario import Scenario


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
Flag = Annotated[bool, Parameter(negative="")]
# one or many, or all that follow the option
Many = Parameter(consume_multiple=True, negative="", show_default=False)
Output = Annotated[Path, Parameter(name=["--output", "-o"])]


@Parameter(name="*")
@dataclass(frozen=True)
class Options:
    """What every command takes that writes results.

    Attributes
    ----------
    force
        Replace what is there already: a file, or results of another run in the folder.
    quiet
        Print nothing but errors.
    verbose
        Print the memory in use after every stage.
    """

    force: Flag = False
    quiet: Annotated[bool, Parameter(name=["--quiet", "-q"], negative="")] = False
    verbose: Annotated[bool, Parameter(name=["--verbose", "-v"], negative="")] = False

    @property
    def console(self) -> Console:
        """Where the command prints."""
        return Console(quiet=self.quiet, soft_wrap=True)

    def stages(self) -> Stages:
        """What shows and times the stages of the run."""
        return Stages(self.console, verbose=self.verbose)

    def running(self) -> dict[str, bool | Stages]:
        """What every run takes."""
        return {"replace": self.force, "stages": self.stages()}

    def say(self, *lines: object) -> None:
        """Print lines as they are."""
        say(self.console, *lines)

    def tell(self, files: Sequence[Path], *lines: object, table: Table | None = None) -> None:
        """Print which files were written, a table, and what else there is to say."""
        self.say(*(f"  {path}" for path in files))
        if table is not None:
            show(self.console, table)
        self.say(*lines)


@Parameter(name="*")
@dataclass(frozen=True)
class ScenarioOptions(Options):
    """What commands take that read a scenario.

    Attributes
    ----------
    set_
        key.path=value; overrides an entry of the scenario, as often as needed.
    """

    set_: Annotated[tuple[str, ...], Parameter(name="--set", negative="", show_default=False)] = ()

    def load(
        self,
        source: str,
        frequencies: str | None = None,
        replaces: Path | None = None,
        **flags: str | int | bool | None,
    ) -> Scenario:
        """The scenario of the command, with ``--set`` and with what options say of it.

        Parameters
        ----------
        source : str
            A YAML file or the name of a scenario.
        frequencies : str
            See :func:`parse_frequencies`.
        replaces : Path
            The folder or file of the results: with ``--force`` not one that the scenario is in.
        **flags
            Values of entries, dots written as ``__``; those that are None or False are left alone.

        Raises
        ------
        InputError
            As :func:`.load_scenario`, and as :func:`.require_apart`.
        """
        from lusee_bayes.core.files import require_apart
        from lusee_bayes.experiment.scenario import load_scenario

        if replaces is not None and self.force:
            require_apart(replaces, [source])
        overrides = list(self.set_)
        if frequencies is not None:
            overrides.append(f"frequencies_mhz={parse_frequencies(frequencies)}")
        for name, value in flags.items():
            if value is not None and value is not False:
                overrides.append(f"{name.replace('__', '.')}={str(value).lower()}")
        return load_scenario(source, overrides)


@Parameter(name="*")
@dataclass(frozen=True)
class DataOptions(ScenarioOptions):
    """What commands take that work on data.

    Attributes
    ----------
    data
        Visibilities to use, of a file of simulate or reduce, a waterfall of luseepy, or sessions of
        its lusee.ingest, one or many; without them the scenario's own are simulated.
    clock
        Clock reference in JSON, for sessions with no absolute time, or to correct the UTC that they
        state (flight.clock).
    output
        Folder for the results; by default output/NAME, with the command's own ending.
    """

    data: Annotated[tuple[Path, ...] | None, Many] = None
    clock: str | None = None
    output: Output | None = None

    def loaded(
        self, source: str, frequencies: str | None = None, **flags: str | int | bool | None
    ) -> Scenario:
        """The scenario with its clock. InputError as :meth:`load`."""
        return self.load(source, frequencies, self.output, flight__clock=self.clock, **flags)

    def folder(self, source: str, suffix: str = "") -> Path:
        """Where the results of a scenario go."""
        return self.output or Path("output") / f"{Path(source).stem}{suffix}"


@Parameter(name="*")
@dataclass(frozen=True)
class EngineOptions:
    """What carries out the tasks of a run.

    Attributes
    ----------
    workers
        Processes of this machine that share out the work; by default one.
    cluster
        Address of a Dask scheduler, as tcp://host:8786, whose workers share out the work; by
        default DASK_SCHEDULER_ADDRESS.
    """

    workers: Count | None = None
    cluster: str | None = None

    def open(self, demand: Demand) -> AbstractContextManager[Engine]:
        """Start it for the block. InputError as :func:`.open_engine`."""
        from lusee_bayes.core.engines import open_engine

        return open_engine(demand, self.workers, self.cluster)


# a number and its unit
DURATION = re.compile(r"\s*([0-9]*\.?[0-9]+(?:e[+-]?[0-9]+)?)\s*(s|min|h|d)\s*", re.ASCII)
SECONDS = {"s": 1.0, "min": 60.0, "h": 3600.0, "d": 86400.0}


# channels of one run: far more than 25 kHz apart over the band
MOST_CHANNELS = 4096


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
