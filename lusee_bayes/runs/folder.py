"""The folder of a run: written in one transaction, and what its results were made of.

Results of something else are not replaced unless that is asked for, and a run that is interrupted
says what its folder holds.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, TypeVar

from astropy.table import Table
from matplotlib.figure import Figure
from pandas import DataFrame
from pydantic import BaseModel
from xarray import Dataset, DataTree

from lusee_bayes.core import files, reading
from lusee_bayes.core.arrays import use_compilation_cache
from lusee_bayes.core.errors import InputError, WorkersLost
from lusee_bayes.core.progress import Stages
from lusee_bayes.experiment.data_files import Data, digest_of, files_of, names_of_data
from lusee_bayes.experiment.scenario import Scenario
from lusee_bayes.report.figures.drawing import named_parts, save
from lusee_bayes.report.pages import PAGES, REPORT
from lusee_bayes.results.finished_runs import Provenance

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
        For ``manifest.json``.

    Raises
    ------
    InputError
        If there is no file of data.
    """
    origin: dict[str, str] = {}
    if scenario is not None:
        tree = scenario.model_dump(mode="json", exclude={"output"})
        origin |= {name: json.dumps(value) for name, value in _entries(tree)}
    if data is not None:
        names = ", ".join(f"'{Path(name).name}'" for name in names_of_data(data))
        origin["data"] = f"{names} ({digest_of(data)[:12]})"
    return origin | {name: str(value) for name, value in others.items() if value is not None}


def inputs_of(
    scenario: Scenario | None, data: Data | None = None, *others: str | Path | None
) -> list[str | Path]:
    """The files that a run reads: data, those that its scenario names, and others if given."""
    tree = {} if scenario is None else scenario.model_dump(mode="json")
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
    manifest = files.read_manifest(folder)
    if manifest is None:
        return
    before, advice = manifest["origin"], "give another folder with -o, or --force to replace them"
    if manifest["kind"] not in kinds:
        raise InputError(f"'{folder}' contains results of lusee-bayes {manifest['kind']}; {advice}")
    for name in [*origin, *before]:
        old, new = before.get(name), origin.get(name)
        if old != new:
            old, new = (f"{value or 'not given':.60}" for value in (old, new))
            raise InputError(
                f"'{folder}' contains results of another run: {name} was {old}, now {new}; {advice}"
            )


FIGURES = "figures"
Result = TypeVar("Result")


class RunInterrupted(KeyboardInterrupt):
    """A run was interrupted; the message says what its folder holds."""


@dataclass(frozen=True)
class RunOutcome(Generic[Result]):
    """A finished run.

    Attributes
    ----------
    result : object
        What it has found.
    folder : Path
    files : list of Path
        What was written.
    """

    result: Result
    folder: Path
    files: list[Path]

    @property
    def page(self) -> Path:
        """The page for people, of runs that have one."""
        return self.folder / REPORT


@dataclass(frozen=True)
class Output:
    """A file, or several, of a run's folder.

    Attributes
    ----------
    write : callable
        ``write(result, folder)`` writes into a folder.
    wanted : callable
        ``wanted(result)``: whether the run has it.
    """

    write: Callable[[Any, Path], None]
    wanted: Callable[[Any], bool] = lambda result: True

    @classmethod
    def text(cls, name: str, text: Callable[[Any], str]) -> Output:
        """A file of text, UTF-8."""
        return cls(lambda run, folder: (folder / name).write_text(text(run), encoding="utf-8"))

    @classmethod
    def model(cls, name: str, figures: Callable[[Any], BaseModel]) -> Output:
        """A pydantic model as JSON."""
        return cls.text(name, lambda run: figures(run).model_dump_json(indent=2) + "\n")

    @classmethod
    def rows(cls, name: str, rows: Callable[[Any], Sequence[Mapping[str, object]]]) -> Output:
        """A table, row by row."""
        return cls(lambda run, folder: reading.write_csv(folder / name, rows(run)))

    @classmethod
    def ecsv(cls, name: str, table: Callable[[Any], Table]) -> Output:
        """A table of astropy, with its units."""
        options = {"format": "ascii.ecsv", "delimiter": ","}
        return cls(lambda run, folder: table(run).write(folder / name, **options))

    @classmethod
    def table(cls, name: str, table: Callable[[Any], DataFrame | None]) -> Output:
        """A table of pandas; None where the run has none."""
        return cls(
            lambda run, folder: table(run).to_csv(folder / name, index=False),
            lambda run: table(run) is not None,
        )

    @classmethod
    def netcdf(cls, name: str, content: Callable[[Any], Dataset | DataTree]) -> Output:
        """A netCDF file, of a dataset or a tree of them."""
        return cls(lambda run, folder: content(run).to_netcdf(folder / name, engine="h5netcdf"))


SCENARIO = Output.text("scenario.yaml", lambda result: result.scenario.to_yaml())


@dataclass(frozen=True)
class RunKind:
    """What the folder of one kind of run holds.

    Attributes
    ----------
    name : str
        Kept in ``manifest.json``; a page of this name in ``PAGES`` becomes ``report.html``.
    outputs : sequence of Output
    figures : mapping
        ``draw(result)`` by the name of its PNG in ``figures/``: a figure, several by their titles,
        or None where there is none.
    unfinished : str
        The folder that holds unfinished work, removed when the results are there.
    dpi : int
        Of the figures.
    after : sequence of str
        Kinds of runs whose results in the folder, of the same origin, it takes over.
    resume : str
        How a run that was stopped is gone on with.
    """

    name: str
    outputs: Sequence[Output]
    figures: Mapping[str, Callable[[Any], Figure | dict[str, Figure] | None]]
    unfinished: str = ""
    dpi: int = 110
    after: Sequence[str] = ()
    resume: str = ""


@dataclass(frozen=True)
class RunFolder:
    """The folder of a run while it is open.

    Attributes
    ----------
    path : Path
    kind : RunKind
    origin : mapping
        What the results are made of (:func:`.origin_of`).
    """

    path: Path
    kind: RunKind
    origin: Origin

    def write(
        self, result: Result, stages: Stages, provenance: Provenance | None = None
    ) -> RunOutcome[Result]:
        """Draw all figures and write all files of a run, in one transaction.

        Parameters
        ----------
        result : object
            What the outputs and figures of the kind take.
        stages : Stages
            Told what is being done.
        provenance : Provenance, optional
            Where the data come from, for the head of the page.

        Returns
        -------
        Run
            With the files in the folder.
        """
        kind, folder = self.kind, self.path
        discard = [kind.unfinished] if kind.unfinished else []
        with files.transaction(folder, kind.name, discard, self.origin) as stage:
            if kind.figures:
                (stage / FIGURES).mkdir()
                with stages("figures"):
                    for name, draw in kind.figures.items():
                        for part, figure in named_parts(name, draw(result)).items():
                            save(figure, stage / FIGURES / f"{part}.png", kind.dpi)
            with stages("files"):
                for output in kind.outputs:
                    if output.wanted(result):
                        output.write(result, stage)
                if provenance is not None:
                    provenance.write(stage)
                if kind.name in PAGES:
                    page = PAGES[kind.name](stage, folder.resolve().name)
                    (stage / REPORT).write_text(page, encoding="utf-8")
            written = [path.relative_to(stage) for path in stage.rglob("*") if path.is_file()]
        return RunOutcome(result, folder, [folder / name for name in sorted(written)])


@contextmanager
def run_folder(
    folder: str | Path,
    kind: RunKind,
    scenario: Scenario | None = None,
    data: Data | None = None,
    *inputs: str | Path | None,
    replace: bool = False,
    **others: object,
) -> Iterator[RunFolder]:
    """Open a folder for a run, and say what it holds if the run is interrupted.

    Parameters
    ----------
    folder : path
    kind : RunKind
    scenario : Scenario, optional
    data : Visibilities, path, or sequence of them, optional
    *inputs
        Other files that the run reads, if given (:func:`inputs_of`): none is replaced.
    replace : bool
        Replace results of another run.
    **others
        What else determines the numbers (:func:`origin_of`).

    Yields
    ------
    RunFolder
        An interrupted transaction of an earlier run is completed.

    Raises
    ------
    InputError
        If ``folder``, or what it would lie in, is a file; if another run works in it, or has left
        its results there; if what the run reads is among the results that would be replaced.
    RunInterrupted
        Instead of KeyboardInterrupt.
    WorkersLost
        With what the folder holds added to its message.
    """
    origin, read = origin_of(scenario, data, **others), inputs_of(scenario, data, *inputs)
    folder = files.user_path(folder)
    files.require_folder(folder)
    made = [place for place in (folder, *folder.parents) if not place.exists()]
    folder.mkdir(parents=True, exist_ok=True)
    try:
        with files.locked(folder):
            files.recover(folder)
            if not replace:
                require_own(folder, (kind.name, *kind.after), origin)
            else:
                files.require_apart(folder, read)
            before = _written_at(folder)
            use_compilation_cache()
            try:
                yield RunFolder(folder, kind, origin)
            except RunInterrupted:
                # of a run in a folder inside this one
                raise
            except KeyboardInterrupt as interrupt:
                raise RunInterrupted(_state(folder, before, kind)) from interrupt
            except WorkersLost as error:
                raise WorkersLost(f"{error}; {_state(folder, before, kind)}") from error
    finally:
        # nothing written: nothing left
        for place in ([folder / kind.unfinished] if kind.unfinished else []) + made:
            with suppress(OSError):
                place.rmdir()


def _written_at(folder: Path) -> int | None:
    manifest = folder / files.MANIFEST
    return manifest.stat().st_mtime_ns if manifest.is_file() else None


def _state(folder: Path, before: int | None, kind: RunKind) -> str:
    files.recover(folder)
    now = _written_at(folder)
    if now is not None and now != before:
        return f"the new results in '{folder}' are complete"
    earlier = "no results were written" if now is None else "the earlier results are unchanged"
    resumed = kind.unfinished and any((folder / kind.unfinished).glob("*"))
    return f"{earlier} in '{folder}'{f'; {kind.resume}' if resumed else ''}"
