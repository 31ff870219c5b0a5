"""Options that mean the same in every command, and how a command prints."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, suppress
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from math import inf, isclose
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from cyclopts import Parameter
from rich.console import Console
from rich.table import Table

from lusee_bayes.core.errors import InputError
from lusee_bayes.core.progress import Stages

if TYPE_CHECKING:
    from lusee_bayes.core.engine import Demand, Engine
    from lusee_bayes.experiment.scenario import Scenario

# a number with its unit
DURATION = re.compile(r"\s*([0-9]*\.?[0-9]+(?:e[+-]?[0-9]+)?)\s*(s|min|h|d)\s*", re.ASCII)
SECONDS = {"s": 1.0, "min": 60.0, "h": 3600.0, "d": 86400.0}
# most channels of one run: more than one per 25 kHz over the band
MOST_CHANNELS = 4096


def whole(least: int, text: str) -> int:
    """A whole number of at least ``least``, in ASCII digits. InputError otherwise."""
    if not re.fullmatch("-?[0-9]{1,9}", text) or int(text) < least:
        raise InputError(f"expected a whole number from {least} to 999999999, got {text[:40]}")
    return int(text)


def parse_duration(text: str) -> float:
    """Seconds from ``30s``, ``10min``, ``2h`` or ``1d``. InputError otherwise."""
    match = DURATION.fullmatch(text)
    seconds = float(match[1]) * SECONDS[match[2]] if match else 0.0
    if not 0.0 < seconds < inf:
        raise InputError(f"'{text[:40]}' is not a duration; give one such as 30s, 10min, 2h or 1d")
    return seconds


def parse_frequencies(text: str) -> list[float]:
    """Frequencies in MHz from ``10,25,30`` or ``first:last:step``, the last included.

    InputError if it is neither.
    """
    mhz, count = [], 0
    with suppress(ValueError, ZeroDivisionError, OverflowError):
        if ":" not in text:
            mhz = [float(part) for part in text.split(",")]
        else:
            first, last, step = (float(part) for part in text.split(":"))
            count = round((last - first) / step)
            if step > 0 and isclose(first + count * step, last, rel_tol=1e-5, abs_tol=1e-8):
                mhz = [first + k * step for k in range(min(count, MOST_CHANNELS) + 1)]
    if count >= MOST_CHANNELS:
        wrong = f"{text} gives {count + 1} channels; one run allows at most {MOST_CHANNELS}"
        raise InputError(wrong)
    if not mhz or any(b <= a for a, b in pairwise(mhz)):
        wrong = f"expected increasing MHz, as 10,25,30 or 5:50:5 (first:last:step), got {text[:40]}"
        raise InputError(wrong)
    return mhz


def _read_by(read: Callable[[str], Any]) -> Parameter:
    return Parameter(converter=lambda _, tokens: read(tokens[0].value), n_tokens=1, negative="")


# a number of items: zero allowed, or at least one
Number = Annotated[int, _read_by(partial(whole, 0))]
Count = Annotated[int, _read_by(partial(whole, 1))]
Duration = Annotated[float, _read_by(parse_duration)]
Frequencies = Annotated[list[float], _read_by(parse_frequencies)]
Flag = Annotated[bool, Parameter(negative="")]
Quiet = Annotated[bool, Parameter(name=["--quiet", "-q"], negative="")]
# an option that may be repeated; and one that takes all values that follow it
Repeated = Parameter(negative="", show_default=False)
Many = Parameter(consume_multiple=True, negative="", show_default=False)


@Parameter(name="*")
@dataclass(frozen=True)
class Options:
    """Options of every command that writes results.

    Attributes
    ----------
    output
        Folder or file for the results; the help text above gives the default.
    force
        Overwrite an existing file, or results of another run in the folder.
    quiet
        Print only errors.
    verbose
        Also print memory use after every stage, details of the result, and its files.
    """

    output: Annotated[Path | None, Parameter(name=["--output", "-o"])] = None
    force: Flag = False
    quiet: Quiet = False
    verbose: Annotated[bool, Parameter(name=["--verbose", "-v"], negative="")] = False

    def running(self) -> dict[str, Any]:
        """Arguments of every run."""
        console = Console(quiet=self.quiet, soft_wrap=True, emoji=False)
        return {"replace": self.force, "stages": Stages(console, verbose=self.verbose)}

    def print(self, *lines: object, files: Sequence[Path] = ()) -> None:
        """Print the files with --verbose, then lines and tables."""
        say(*(f"  {path}" for path in files if self.verbose), *lines, quiet=self.quiet)


@Parameter(name="*")
@dataclass(frozen=True)
class ScenarioOptions(Options):
    """Options of commands that read a scenario.

    Attributes
    ----------
    set_
        key.path=value: override a key of the scenario; may be repeated.
    """

    set_: Annotated[tuple[str, ...], Parameter(name="--set"), Repeated] = ()

    def load(self, source: str, **entries: object) -> Scenario:
        """The scenario of the command, with ``--set`` and the entries that options set.

        Parameters
        ----------
        source : str
            A YAML file or the name of a scenario.
        **entries
            Values of entries, dots written as ``__``; None and False leave an entry unchanged.

        Raises
        ------
        InputError
            As :func:`.load_scenario`, and as :func:`.require_apart` with --force.
        """
        from lusee_bayes.core.files import require_apart
        from lusee_bayes.experiment.scenario import load_scenario

        if self.output is not None and self.force:
            require_apart(self.output, [source])
        given = [
            f"{name.replace('__', '.')}={json.dumps(value)}"
            for name, value in entries.items()
            if value is not None and value is not False
        ]
        return load_scenario(source, [*self.set_, *given])

    def folder(self, source: str, suffix: str = "") -> Path:
        """The folder for the results of a scenario."""
        return self.output or Path("output") / f"{Path(source).stem}{suffix}"


@Parameter(name="*")
@dataclass(frozen=True)
class DataOptions(ScenarioOptions):
    """Options of commands that process data.

    Attributes
    ----------
    data
        Data to use: a file written by simulate or reduce, one file of visibilities for each
        frequency, a luseepy waterfall, or session files of lusee.ingest. If omitted, data are
        simulated from the scenario.
    clock
        Clock reference (JSON), for sessions with no absolute time or to correct their UTC
        (flight.clock).
    """

    data: Annotated[tuple[Path, ...] | None, Many] = None
    clock: str | None = None

    def load(self, source: str, **entries: object) -> Scenario:
        """As :meth:`ScenarioOptions.load`, with the clock."""
        if self.clock is not None and self.data is None:
            raise InputError("--clock is for session files; give them with --data")
        return super().load(source, flight__clock=self.clock, **entries)

    def running(self) -> dict[str, Any]:
        """Arguments of every run, and the data."""
        return super().running() | {"data": self.data}


@Parameter(name="*")
@dataclass(frozen=True)
class EngineOptions:
    """Options for distributing the tasks of a run.

    Attributes
    ----------
    workers
        Number of worker processes on this machine (default: 1).
    cluster
        Address of a Dask scheduler whose workers do the work, such as tcp://host:8786 (default:
        DASK_SCHEDULER_ADDRESS).
    """

    workers: Count | None = None
    cluster: str | None = None

    def open(self, demand: Demand) -> AbstractContextManager[Engine]:
        """Start the engine for the block. InputError as :func:`.open_engine`."""
        from lusee_bayes.core.engine import open_engine

        return open_engine(demand, self.workers, self.cluster)


Algorithm = Literal["nuts", "hmc", "crank-nicolson"]
Licence = Literal["CC-BY-4.0", "CC0-1.0"]


@Parameter(name="*")
@dataclass(frozen=True)
class ChainOptions:
    """Options of commands that sample.

    Attributes
    ----------
    resume
        Continue the unfinished run in the folder, or re-evaluate a finished one.
    chains
        Number of chains, run in parallel.
    draws
        Number of draws per chain, after warmup.
    warmup
        Number of iterations used to adapt the step size; they are discarded.
    """

    resume: Flag = False
    chains: Count = 4
    draws: Count = 1000
    warmup: Number = 150

    def running(self, seed: int, algorithm: Algorithm | None = None) -> dict[str, Any]:
        """Arguments of every run that samples."""
        from lusee_bayes.sampling.hmc import Sampler

        sampler = Sampler(self.chains, self.warmup, self.draws, seed, algorithm)
        return {"sampler": sampler, "resume": self.resume}


def say(*lines: object, quiet: bool = False, stderr: bool = False) -> None:
    """Print lines without markup, and tables with wrapped cells in the width of the terminal."""
    console = Console(quiet=quiet, stderr=stderr, emoji=False)
    for line in lines:
        if isinstance(line, Table):
            console.print(line)
        else:
            console.print(str(line), soft_wrap=True, highlight=False, markup=False)
