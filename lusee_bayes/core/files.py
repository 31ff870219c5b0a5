"""Files and folders that are written whole or not at all.

A folder of results changes in one transaction. Everything is written into a scratch folder first;
renaming that one is the moment from which the new results count. Its files are then moved into
place, and where that is interrupted, whoever opens the folder next (:func:`recover`) completes it.
"""

from __future__ import annotations

import errno
import json
import os
import re
import shutil
import signal
import socket
import tempfile
import threading
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path, PurePosixPath

from lusee_bayes.core.destinations import require_folder, require_target
from lusee_bayes.core.errors import InputError
from lusee_bayes.core.paths import user_path

# names inside a folder of results: scratch folders (with the process's number and its host, since
# several may share a disk), the new results that are still to be moved into place, and the list of
# what the last run has written
SCRATCH, COMMITTED, MANIFEST = ".partial-", ".committed", "manifest.json"


def require_files(folder: Path, names: Sequence[str], command: str) -> None:
    """InputError if ``folder`` lacks one of the files that ``lusee-bayes command`` writes."""
    for name in names:
        if not (folder / name).is_file():
            raise InputError(
                f"'{folder}' has no {name}; make the results again with lusee-bayes {command}"
            )


@contextmanager
def transaction(
    folder: str | Path,
    kind: str,
    discard: Sequence[str] = (),
    origin: Mapping[str, str] | None = None,
) -> Iterator[Path]:
    """Write a run's results into a folder: all of them take effect at once, or none does.

    Files that an earlier run has left there and this one does not write are removed; files that no
    run has written stay.

    Parameters
    ----------
    folder : path
        Folder of the results; made if there is none.
    kind : str
        The kind of run, kept in ``manifest.json``.
    discard : sequence of str
        Folders inside ``folder`` that hold unfinished work, removed with the old results.
    origin : mapping, optional
        What the results are made of, kept in ``manifest.json``.

    Yields
    ------
    Path
        A scratch folder to write the results into.

    Raises
    ------
    InputError
        If ``folder``, or what it would lie in, is a file; if one of the results has the name of a
        folder there; and as :func:`recover`.
    """
    folder = user_path(folder)
    require_folder(folder)
    folder.mkdir(parents=True, exist_ok=True)
    recover(folder)
    stage = scratch_folder(folder)
    try:
        with _naming_last(folder, stage):
            yield stage
        files = sorted(str(p.relative_to(stage)) for p in stage.rglob("*") if p.is_file())
        _require_free(folder, files)
        manifest = {
            "kind": kind,
            "files": files,
            "discard": list(discard),
            "origin": dict(origin or {}),
        }
        (stage / MANIFEST).write_text(json.dumps(manifest, indent=2) + "\n", encoding="utf-8")
        with uninterrupted():
            os.replace(stage, folder / COMMITTED)
            recover(folder)
    finally:
        shutil.rmtree(stage, ignore_errors=True)


def require_apart(folder: Path, inputs: Iterable[str | Path]) -> None:
    """InputError where a run would replace its inputs: results in its folder, or its file."""
    manifest = read_manifest(folder)
    names = manifest["files"] if manifest else ()
    written = {folder.resolve(), *((folder / name).resolve() for name in names)}
    for path in inputs:
        if Path(path).resolve() in written:
            raise InputError(
                f"'{path}' is an input of this run, which would replace it; give another place "
                "for the results with -o"
            )


def recover(folder: str | Path) -> None:
    """Complete what an interrupted transaction has begun, and remove scratch folders left behind.

    Harmless at any time; every reader of a folder of results calls it first.

    Raises
    ------
    InputError
        If the folder's manifest cannot be read.
    """
    folder = user_path(folder)
    if not folder.is_dir():
        return
    old, committed = read_manifest(folder), folder / COMMITTED
    # a new manifest is moved last: until then this can be begun again, and where there is none the
    # new results are in place
    new = read_manifest(committed)
    if new is not None:
        for name in new["files"]:
            if (committed / name).is_file():
                (folder / name).parent.mkdir(parents=True, exist_ok=True)
                _move(committed / name, folder / name)
        for name in sorted(set(old["files"] if old else ()) - set(new["files"])):
            (folder / name).unlink(missing_ok=True)
            _remove_if_empty((folder / name).parent, folder)
        for name in new["discard"]:
            shutil.rmtree(folder / name, ignore_errors=True)
        _move(committed / MANIFEST, folder / MANIFEST)
    shutil.rmtree(committed, ignore_errors=True)
    remove_left_scratch(folder)


def scratch_folder(folder: Path) -> Path:
    """Make a folder in ``folder`` for this process alone."""
    prefix = f"{SCRATCH}{os.getpid()}-{socket.gethostname()}-"
    return Path(tempfile.mkdtemp(prefix=prefix, dir=folder))


def remove_left_scratch(folder: Path) -> None:
    """Remove the scratch folders of processes of this host that have ended."""
    for scratch in folder.glob(f"{SCRATCH}*"):
        process, _, rest = scratch.name.removeprefix(SCRATCH).partition("-")
        # a process of another host is not to be seen from here
        if rest.rpartition("-")[0] == socket.gethostname() and not _alive(process):
            shutil.rmtree(scratch, ignore_errors=True)


def _move(source: Path, target: Path) -> None:
    # where another process completes the same transaction, it may have moved the file already
    with suppress(FileNotFoundError):
        os.replace(source, target)


def _remove_if_empty(place: Path, folder: Path) -> None:
    """Remove the folder ``place``, and those that it lies in below ``folder``, where empty."""
    while place != folder:
        with suppress(FileNotFoundError):
            if any(place.iterdir()):
                return
            place.rmdir()
        place = place.parent


def _require_free(folder: Path, files: Sequence[str]) -> None:
    """InputError if a folder has the name of one of the files, or a file that of a folder."""
    for name in files:
        target = folder / name
        if target.is_dir():
            raise InputError(f"'{target}' is a folder, and a file of the results has its name")
        require_folder(target.parent)


def read_manifest(folder: Path) -> dict | None:
    """What the last run has written into a folder, and of what; None if it is not said.

    Raises
    ------
    InputError
        If the manifest cannot be read.
    """
    path = folder / MANIFEST
    if not path.is_file():
        return None
    try:
        manifest = json.loads(path.read_text(encoding="utf-8"))
        found = {name: manifest[name] for name in ("kind", "files", "discard")}
        if not isinstance(found["kind"], str):
            raise TypeError("the kind of the run is no text")
        if not all(map(_is_inside, (*found["files"], *found["discard"]))):
            raise TypeError("names of files in the folder are expected")
        origin = manifest.get("origin", {})
        if not isinstance(origin, dict):
            raise TypeError("what the results are made of is no object")
        return found | {"origin": origin}
    except (ValueError, KeyError, TypeError, RecursionError, OSError) as error:
        raise InputError(
            f"'{path}' cannot be read ({type(error).__name__}: {error}); delete it, and the next "
            "run replaces the files of its own names"
        ) from error


def _is_inside(name: object) -> bool:
    """Whether it is the name of something inside the folder, and not of the folder itself."""
    if not isinstance(name, str) or not name or "\0" in name:
        return False
    path = PurePosixPath(name)
    return not path.is_absolute() and ".." not in path.parts and bool(path.parts)


def _alive(process: str) -> bool:
    if not process.isdigit():
        return False
    try:
        os.kill(int(process), 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return True


@contextmanager
def uninterrupted() -> Iterator[None]:
    """Hold back the signals that end a program until the block is done."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    came: list[int] = []
    # handlers and not masks: a signal that is masked here is taken by another of JAX's threads
    before = {
        number: signal.signal(number, lambda came_in, _: came.append(came_in))
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
        if signal.getsignal(number) not in (signal.SIG_IGN, None)
    }
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        for number in came:
            os.kill(os.getpid(), number)


@contextmanager
def naming_disk(path: Path) -> Iterator[None]:
    """Put the name of the file that is written into an OSError of the block that has none.

    HDF5 puts the error's number into its message alone, and astropy gives none.
    """
    try:
        yield
    except OSError as error:
        number = re.search(r"errno = (\d+)", str(error))
        full = errno.ENOSPC if "Not enough space on disk" in str(error) else None
        code = error.errno or (int(number[1]) if number else full)
        if code is None:
            raise
        raise OSError(code, os.strerror(code), error.filename or str(path)) from error


@contextmanager
def _naming_last(folder: Path, stage: Path) -> Iterator[None]:
    """The same for several files in turn: the one that was written last, where it will lie."""
    try:
        yield
    except OSError as error:
        written = [path for path in stage.rglob("*") if path.is_file()]
        last = max(written, key=lambda path: path.stat().st_mtime_ns, default=stage)
        with naming_disk(folder / last.relative_to(stage)):
            raise error


@contextmanager
def replacing(path: str | Path) -> Iterator[Path]:
    """Write a single file whole or not at all.

    Yields
    ------
    Path
        A scratch name beside ``path``; what is written there takes its place when all is done. If
        anything fails or is interrupted before that, the previous file stays as it was.

    Raises
    ------
    InputError
        If the file cannot be written, or something else than a file has its name.
    """
    path = user_path(path)
    require_target(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".{path.name}.{os.getpid()}.partial")
    try:
        with naming_disk(path):
            yield partial
        os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)
