"""Files and folders that are written whole or not at all.

A folder of results changes in one transaction. Everything is written into a scratch folder first;
renaming that one is the moment from which the new results count. Its files are then moved into
place, and where that is interrupted, whoever opens the folder next (:func:`recover`) completes it.
The folder itself is not replaced: it holds files of the user's own, a shell may stand in it, and it
may be a mount point.

Where results cannot be written is found out before anything is computed (:func:`require_folder`,
:func:`require_target`).
"""

from __future__ import annotations

import errno
import os
import re
import shutil
import socket
import tempfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path, PurePosixPath
from typing import Annotated, Any

from filelock import FileLock, Timeout
from pydantic import AfterValidator, BaseModel, ValidationError

from lusee_bayes.core.errors import InputError


def user_path(path: str | os.PathLike[str]) -> Path:
    """A path, with the user's folder in place of a leading ``~``."""
    return Path(os.path.expanduser(path))


def require_folder(folder: str | Path) -> None:
    """Check that results can be written into a folder, which need not be there yet.

    Parameters
    ----------
    folder : path

    Raises
    ------
    InputError
        If it, or what it would lie in, is no folder or cannot be written into; if its name is too
        long; and for the root of all files.
    """
    folder = user_path(folder)
    _require_name(folder)
    if folder.resolve() == Path(folder.resolve().anchor):
        raise InputError(f"'{folder}' is the root of all files; give a folder for the results")
    place = next(place for place in (folder, *folder.absolute().parents) if _is_there(place))
    if not place.is_dir():
        kind = "a file" if place.is_file() else "neither a file nor a folder"
        raise InputError(f"'{place}' is {kind}; give a folder for the results")
    try:
        # a file without a name: whatever happens, nothing of it is left
        tempfile.TemporaryFile(dir=place).close()
    except OSError as error:
        raise InputError(
            f"cannot write into '{place}': {error.strerror}; give another folder"
        ) from error


def require_target(path: str | Path) -> None:
    """Check that a single file can be written, or replaced.

    Parameters
    ----------
    path : path

    Raises
    ------
    InputError
        If it is a folder, a pipe or a device, or as :func:`require_folder` for what it lies in.
    """
    path = user_path(path)
    _require_name(path)
    is_there = _is_there(path)
    if not path.name or path.is_dir():
        raise InputError(f"'{path}' is a folder; give the name of a file for the results")
    if is_there and not path.is_file():
        raise InputError(f"'{path}' is neither a file nor a folder; give the name of a file")
    if path.absolute().parent != Path(path.absolute().anchor):
        require_folder(path.parent)


def require_new(path: str | Path, *, replace: bool, inputs: Iterable[str | Path] = ()) -> None:
    """As :func:`require_target`, for a file that another is only replaced by if that is asked for.

    Parameters
    ----------
    path : path
    replace : bool
        Replace what is there.
    inputs : iterable of path
        Files that are read for it, and not to be replaced.

    Raises
    ------
    InputError
        If something is there, unless ``replace``; if it is one of ``inputs``; as
        :func:`require_target`.
    """
    require_target(path)
    if user_path(path).resolve() in [user_path(read).resolve() for read in inputs]:
        raise InputError(f"'{path}' is an input of this run; give another name with -o")
    if not replace and user_path(path).exists():
        raise InputError(f"'{path}' exists already; give another name, or --force")


def _require_name(path: Path) -> None:
    if "\0" in str(path) or not str(path):
        raise InputError(f"'{path!s}' is not a valid file name; remove the NUL characters")


def _is_there(path: Path) -> bool:
    """Whether something is at a path. A link to nothing is something that cannot be used."""
    try:
        path.stat()
    except (FileNotFoundError, NotADirectoryError):
        if path.is_symlink():
            raise InputError(f"'{path}' is a broken link; remove it") from None
        return False
    except OSError as error:
        raise InputError(f"'{path}' cannot be used for the results: {error.strerror}") from error
    return True


# names inside a folder of results: the lock of the run that works in it, which says whose it is,
# scratch folders, the new results that are still to be moved into place, and the list of what the
# last run has written
LOCK, SCRATCH, COMMITTED, MANIFEST = ".lock", ".partial-", ".committed", "manifest.json"


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Keep other runs out of a folder, which is there, during the block.

    The lock ends with the process, however that ends. What a run that was killed has left in
    scratch folders is removed.

    Raises
    ------
    InputError
        If another run works in it.
    """
    path, lock, owner = folder / LOCK, FileLock(folder / LOCK), "another process"
    try:
        lock.acquire(blocking=False)
    except Timeout as error:
        with suppress(FileNotFoundError):
            owner = path.read_text(encoding="utf-8", errors="replace") or owner
        raise InputError(
            f"another run uses '{folder}' ({owner}); wait for it to end, or give another folder"
        ) from error
    try:
        path.write_text(f"process {os.getpid()} on {socket.gethostname()}", encoding="utf-8")
        for scratch in folder.glob(f"{SCRATCH}*"):
            shutil.rmtree(scratch, ignore_errors=True)
        yield
    finally:
        path.unlink(missing_ok=True)
        lock.release()


def require_files(folder: Path, names: Sequence[str], command: str) -> None:
    """InputError if ``folder`` lacks one of the files that ``lusee-bayes command`` writes."""
    for name in names:
        if not (folder / name).is_file():
            raise InputError(
                f"'{folder}' has no {name}; make the results again with lusee-bayes {command}"
            )


def _is_inside(name: str) -> str:
    path = PurePosixPath(name)
    if "\0" in name or path.is_absolute() or ".." in path.parts or not path.parts:
        raise ValueError("names of files in the folder are expected")
    return name


# the name of something in the folder, and not of the folder itself
_Inside = Annotated[str, AfterValidator(_is_inside)]


class _Manifest(BaseModel):
    kind: str
    files: list[_Inside]
    discard: list[_Inside]
    origin: dict[str, str] = {}


def read_manifest(folder: Path) -> dict[str, Any] | None:
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
        return _Manifest.model_validate_json(path.read_bytes()).model_dump()
    except (ValidationError, OSError) as error:
        why = error.errors()[0]["msg"] if isinstance(error, ValidationError) else error.strerror
        raise InputError(
            f"'{path}' cannot be read ({why}); delete it: the next run then replaces its own files"
        ) from error


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
        Folder of the results; made if there is none. :func:`locked`, where several runs may write.
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
        try:
            yield stage
        except OSError as error:
            # of several files the one that was written last, where it will lie
            written = [path for path in stage.rglob("*") if path.is_file()]
            last = max(written, key=lambda path: path.stat().st_mtime_ns, default=stage)
            with naming_disk(folder / last.relative_to(stage)):
                raise error
        files = sorted(str(p.relative_to(stage)) for p in stage.rglob("*") if p.is_file())
        for target in (folder / name for name in files):
            if target.is_dir():
                raise InputError(f"'{target}' is a folder, but a result file has the same name")
            require_folder(target.parent)
        said = _Manifest(kind=kind, files=files, discard=list(discard), origin=dict(origin or {}))
        (stage / MANIFEST).write_text(said.model_dump_json(indent=2) + "\n", encoding="utf-8")
        os.replace(stage, folder / COMMITTED)
        recover(folder)
    finally:
        shutil.rmtree(stage, ignore_errors=True)


def scratch_folder(folder: Path) -> Path:
    """Make a folder in ``folder`` for the run that has locked it."""
    return Path(tempfile.mkdtemp(prefix=SCRATCH, dir=folder))


def recover(folder: str | Path) -> None:
    """Complete what an interrupted transaction has begun.

    Harmless at any time; every reader of a folder of results calls it first.

    Raises
    ------
    InputError
        If the folder's manifest cannot be read.
    """
    folder = user_path(folder)
    committed = folder / COMMITTED
    old, new = read_manifest(folder), read_manifest(committed)
    # a new manifest is moved last: until then this can be begun again, and where there is none the
    # new results are in place
    if new is not None:
        for name in new["files"]:
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            _move(committed / name, folder / name)
        for name in sorted(set(old["files"] if old else ()) - set(new["files"])):
            (folder / name).unlink(missing_ok=True)
            # and the folders that it was in, as far as they are empty
            for place in PurePosixPath(name).parents:
                with suppress(OSError):
                    (folder / place).rmdir()
        for name in new["discard"]:
            shutil.rmtree(folder / name, ignore_errors=True)
        _move(committed / MANIFEST, folder / MANIFEST)
    shutil.rmtree(committed, ignore_errors=True)


def _move(source: Path, target: Path) -> None:
    # moved already, by what was interrupted or by another process that completes the same
    with suppress(FileNotFoundError):
        os.replace(source, target)


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


@contextmanager
def new_folder(folder: Path) -> Iterator[Path]:
    """Write a new folder whole or not at all.

    Yields
    ------
    Path
        A scratch folder beside ``folder``, which takes its name when all is done.

    Raises
    ------
    InputError
        If ``folder`` exists, and as :func:`require_folder`.
    """
    require_folder(folder)
    if folder.exists():
        raise InputError(f"'{folder}' exists already; give the name of a new folder")
    folder.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=SCRATCH, dir=folder.parent) as scratch:
        # not the scratch folder itself, which only its owner may read
        stage = Path(scratch) / folder.name
        stage.mkdir()
        yield stage
        os.rename(stage, folder)
