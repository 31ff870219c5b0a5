"""The folder of a run: written in one transaction, with a record of the inputs.

Results of another run are replaced only on request. An interrupted run reports the state of its
folder.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, TypeVar

import jax
from astropy.table import Table
from matplotlib.figure import Figure
from pandas import DataFrame
from pydantic import BaseModel
from xarray import Dataset, DataTree

from lusee_bayes.core import arrays, files, formats, progress
from lusee_bayes.core.errors import InputError, WorkersLost
from lusee_bayes.core.version import __version__
from lusee_bayes.experiment.data_files import Data, digest_of, files_of, names_of_data
from lusee_bayes.experiment.scenario import Scenario
from lusee_bayes.report.figures.drawing import named_parts, save
from lusee_bayes.report.pages import PAGES, REPORT
from lusee_bayes.results.finished_runs import Provenance, text_hash


def origin_of(
    scenario: Scenario | None = None, data: Data | None = None, **others: object
) -> dict[str, str]:
    """Everything that determines the numbers of a run, as text by name.

    Parameters
    ----------
    scenario : Scenario, optional
        Its section ``output`` is ignored.
    data : Visibilities, path, or sequence of them, optional
        Identified by the names of their files and a digest of their content.
    **others
        Other inputs; None is left out.

    Returns
    -------
    dict
        For ``manifest.json``.

    Raises
    ------
    InputError
        If a data file does not exist.
    """
    origin: dict[str, str] = {}
    if scenario is not None:
        tree = scenario.model_dump(mode="json", exclude={"output"})
        origin |= {name: json.dumps(value) for name, value in _entries(tree)}
    if data is not None:
        names = ", ".join(f"'{Path(name).name}'" for name in names_of_data(data))
        origin["data"] = f"{names} ({digest_of(data)[:12]})"
    return origin | {name: str(value) for name, value in others.items() if value is not None}


def identity_of(scenario: Scenario, *inputs: object) -> str:
    """Digest of everything that determines results: scenario, its files, inputs, and version."""
    given = scenario.to_yaml(), contents_of(scenario), *map(str, inputs), __version__
    return text_hash(json.dumps(given))


def contents_of(scenario: Scenario) -> str:
    """Name and digest of every file that a scenario names, a line each."""
    return "\n".join(f"{path} ({digest_of(path)[:12]})" for path in inputs_of(scenario))


def inputs_of(
    scenario: Scenario | None, data: Data | None = None, *others: str | Path | None
) -> list[str | Path]:
    """The files that a run reads: data, files named by its scenario, and others if given."""
    tree = {} if scenario is None else scenario.model_dump(mode="json")
    named = [one for one in jax.tree.leaves(tree) if isinstance(one, str)]
    given = [] if data is None else files_of(data)
    return [*given, *filter(os.path.isfile, named), *filter(None, others)]


def _entries(tree: Mapping[str, Any], parents: str = "") -> Iterator[tuple[str, Any]]:
    for key, value in tree.items():
        if isinstance(value, Mapping):
            yield from _entries(value, f"{parents}{key}.")
        else:
            yield f"{parents}{key}", value


def require_own(folder: Path, kinds: Sequence[str], origin: files.Origin) -> None:
    """Check that a folder has no results of another run.

    Parameters
    ----------
    folder : Path
    kinds : sequence of str
        Kind of the new run, and kinds of runs whose results it may continue.
    origin : mapping
        Inputs of the new run (:func:`.origin_of`).

    Raises
    ------
    InputError
        If it has; the message names the first difference.
    """
    if (manifest := files.read_manifest(folder)) is None:
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


@dataclass(frozen=True)
class RunOutcome(Generic[Result]):
    """A finished run.

    Attributes
    ----------
    result : object
    folder : Path
    files : list of Path
        The files written.
    """

    result: Result
    folder: Path
    files: list[Path]

    @property
    def page(self) -> Path:
        """The page for people, for runs that have one."""
        return self.folder / REPORT


@dataclass(frozen=True)
class Output:
    """One or several files in a run's folder.

    Attributes
    ----------
    write : callable
        ``write(result, folder)`` writes into a folder.
    wanted : callable
        ``wanted(result)``: whether the run has this output.
    """

    write: Callable[[Any, Path], None]
    wanted: Callable[[Any], bool] = lambda result: True

    @classmethod
    def text(cls, name: str, text: Callable[[Any], str]) -> Output:
        """A text file, UTF-8."""
        return cls(lambda run, folder: (folder / name).write_text(text(run), encoding="utf-8"))

    @classmethod
    def model(cls, name: str, figures: Callable[[Any], BaseModel]) -> Output:
        """A pydantic model as JSON."""
        return cls.text(name, lambda run: figures(run).model_dump_json(indent=2) + "\n")

    @classmethod
    def rows(cls, name: str, rows: Callable[[Any], Sequence[Mapping[str, object]]]) -> Output:
        """A table, row by row."""
        return cls.table(name, lambda run: DataFrame(rows(run), dtype=object))

    @classmethod
    def ecsv(cls, name: str, table: Callable[[Any], Table]) -> Output:
        """An astropy table, with its units."""
        options = {"format": "ascii.ecsv", "delimiter": ","}
        return cls(lambda run, folder: table(run).write(folder / name, **options))

    @classmethod
    def table(cls, name: str, table: Callable[[Any], DataFrame | None]) -> Output:
        """A pandas table; None if the run has none."""
        # names of files may contain invalid bytes
        given = {"index": False, "errors": "backslashreplace"}
        return cls(
            lambda run, folder: table(run).to_csv(folder / name, **given),
            lambda run: table(run) is not None,
        )

    @classmethod
    def netcdf(cls, name: str, content: Callable[[Any], Dataset | DataTree]) -> Output:
        """A netCDF file from a dataset or a data tree."""
        return cls(lambda run, folder: formats.write_netcdf(content(run), folder / name))


SCENARIO = Output.text("scenario.yaml", lambda result: result.scenario.to_yaml())


@dataclass(frozen=True)
class RunKind:
    """Contents of the folder of one kind of run.

    Attributes
    ----------
    name : str
        Stored in ``manifest.json``; a page of this name in ``PAGES`` becomes ``report.html``.
    outputs : sequence of Output
    figures : mapping
        ``draw(result)`` by the name of its PNG in ``figures/``: a figure, several by their titles,
        or None.
    unfinished : str
        The folder of unfinished work, removed when the results are complete.
    dpi : int
        Resolution of the figures.
    after : sequence of str
        Kinds of runs whose results in the folder, of the same origin, it may continue.
    resume : str
        How to resume a stopped run.
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
        Inputs of the results (:func:`.origin_of`).
    """

    path: Path
    kind: RunKind
    origin: files.Origin

    def write(
        self, result: Result, stages: progress.Stages, provenance: Provenance | None = None
    ) -> RunOutcome[Result]:
        """Draw all figures and write all files of a run, in one transaction.

        Parameters
        ----------
        result : object
            Argument of the kind's outputs and figures.
        stages : Stages
            Reports progress.
        provenance : Provenance, optional
            Origin of the data, for the head of the page.

        Returns
        -------
        RunOutcome
            With the files in the folder.
        """
        kind, folder = self.kind, self.path
        discard = [kind.unfinished] if kind.unfinished else []
        with files.transaction(folder, kind.name, discard, self.origin) as stage:
            if kind.figures:
                (stage / FIGURES).mkdir()
                with stages("figures"):
                    drawn = (
                        (stage / FIGURES / f"{part}.png", figure)
                        for name, draw in kind.figures.items()
                        for part, figure in named_parts(name, draw(result)).items()
                    )
                    save(drawn, kind.dpi)
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
    """Open a folder for a run, and report its state if the run is interrupted.

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
        Other inputs that determine the numbers (:func:`origin_of`).

    Yields
    ------
    RunFolder
        An interrupted transaction of an earlier run is completed first.

    Raises
    ------
    InputError
        If ``folder`` or one of its parents is a file, if another run works in it or has left its
        results there, or if the results to be replaced include a file that the run reads.
    KeyboardInterrupt, WorkersLost
        With the state of the folder in the message.
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
            arrays.use_compilation_cache()
            try:
                yield RunFolder(folder, kind, origin)
            except KeyboardInterrupt as interrupt:
                if interrupt.args:  # the state of a folder inside this one
                    raise
                raise KeyboardInterrupt(_state(folder, before, kind)) from interrupt
            except WorkersLost as error:
                raise WorkersLost(f"{error}; {_state(folder, before, kind)}") from error
    finally:
        # remove folders that stayed empty
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
