"""Files and folders that are written whole or not at all.

A results folder changes in one transaction. All files are first written into a scratch folder;
renaming that folder commits the new results. Its files are then moved into place. If this is
interrupted, the next reader of the folder completes it (:func:`recover`). The folder itself is not
replaced: it may contain the user's files, be the working directory of a shell, or be a mount point.

Runs check that results can be written before they compute anything (:func:`require_folder`,
:func:`require_target`).
"""

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
    """A path with a leading ``~`` expanded to the user's home folder."""
    return Path(os.path.expanduser(path))


def require_folder(folder: str | Path) -> None:
    """Check that results can be written into a folder, which need not exist yet.

    Parameters
    ----------
    folder : path

    Raises
    ------
    InputError
        If it, or its nearest existing parent, is not a writable folder; if its name is too long; or
        if it is the root of the file system.
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
        # an unnamed file: nothing remains of it, whatever happens
        tempfile.TemporaryFile(dir=place).close()
    except OSError as error:
        wrong = f"cannot write into '{place}': {error.strerror}; give another folder"
        raise InputError(wrong) from error


def require_target(path: str | Path) -> None:
    """Check that a single file can be written, or replaced.

    Parameters
    ----------
    path : path

    Raises
    ------
    InputError
        If it is a folder, a pipe or a device, or as in :func:`require_folder` for its parent.
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
    """Check, as :func:`require_target`, a file that replaces another only if ``replace`` is set.

    Parameters
    ----------
    path : path
    replace : bool
        Allow an existing file to be replaced.
    inputs : iterable of path
        Input files of the run, which must not be replaced.

    Raises
    ------
    InputError
        If the path exists, unless ``replace``; if it is one of ``inputs``; as in
        :func:`require_target`.
    """
    require_target(path)
    require_apart(user_path(path), inputs)
    if not replace and user_path(path).exists():
        raise InputError(f"'{path}' exists already; remove it, give another name, or --force")


def _require_name(path: Path) -> None:
    if "\0" in str(path) or not str(path):
        raise InputError(f"'{path!s}' is not a valid file name; remove the NUL characters")


def _is_there(path: Path) -> bool:
    """Whether a path exists; a broken link raises InputError."""
    try:
        path.stat()
    except (FileNotFoundError, NotADirectoryError):
        if path.is_symlink():
            raise InputError(f"'{path}' is a broken link; remove it") from None
        return False
    except OSError as error:
        raise InputError(f"'{path}' cannot be used for the results: {error.strerror}") from error
    return True


# names inside a results folder: the lock of the current run, which names its process; scratch
# folders; committed results that are not yet in place; and the list of files that the last run
# wrote
LOCK, SCRATCH, COMMITTED, MANIFEST = ".lock", ".partial-", ".committed", "manifest.json"


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Keep other runs out of an existing folder during the block.

    The lock ends with the process, even if it is killed. Scratch folders of killed runs are
    removed.

    Raises
    ------
    InputError
        If another run uses the folder.
    """
    path, lock, owner = folder / LOCK, FileLock(folder / LOCK), "another process"
    try:
        lock.acquire(blocking=False)
    except Timeout as error:
        with suppress(FileNotFoundError):
            owner = path.read_text(encoding="utf-8", errors="replace") or owner
        wrong = f"another run uses '{folder}' ({owner}); wait for it to end, or give another folder"
        raise InputError(wrong) from error
    try:
        path.write_text(f"process {os.getpid()} on {socket.gethostname()}", encoding="utf-8")
        for scratch in folder.glob(f"{SCRATCH}*"):
            shutil.rmtree(scratch, ignore_errors=True)
        yield
    finally:
        path.unlink(missing_ok=True)
        lock.release()


def require_files(folder: Path, names: Sequence[str], command: str) -> None:
    """Raise InputError if there is no folder, or no such file of ``lusee-bayes command`` in it."""
    if not os.path.isdir(folder):
        raise InputError(f"'{folder}' is not a folder; give the folder of a finished run")
    for name in names:
        if not (folder / name).is_file():
            wrong = f"'{folder}' has no {name}; give a folder that lusee-bayes {command} made"
            raise InputError(wrong)


def _is_inside(name: str) -> str:
    path = PurePosixPath(name)
    if "\0" in name or path.is_absolute() or ".." in path.parts or not path.parts:
        raise ValueError("names of files in the folder are expected")
    return name


# a name inside the folder, not the folder itself
_Inside = Annotated[str, AfterValidator(_is_inside)]
# everything that determines the numbers of a run, as text by name
Origin = Mapping[str, str]


class _Manifest(BaseModel):
    kind: str
    files: list[_Inside]
    discard: list[_Inside]
    origin: dict[str, str] = {}


def read_manifest(folder: Path) -> dict[str, Any] | None:
    """The files that the last run wrote into a folder, and their origin; None without a manifest.

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
    folder: str | Path, kind: str, discard: Sequence[str] = (), origin: Origin | None = None
) -> Iterator[Path]:
    """Write a run's results into a folder: all of them take effect at once, or none does.

    Files of an earlier run that this run does not write are removed; files that no run wrote are
    kept.

    Parameters
    ----------
    folder : path
        Results folder, created if necessary. Use :func:`locked` if several runs may write to it.
    kind : str
        The kind of run, recorded in ``manifest.json``.
    discard : sequence of str
        Folders of unfinished work inside ``folder``, removed with the old results.
    origin : mapping, optional
        Origin of the results, recorded in ``manifest.json``.

    Yields
    ------
    Path
        A scratch folder to write the results into.

    Raises
    ------
    InputError
        If ``folder`` or a parent is a file; if a result has the name of a folder there; and as in
        :func:`recover`.
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
            # name the file that was written last, by its final path
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
    """Create a scratch folder in ``folder`` for the run that has locked it."""
    return Path(tempfile.mkdtemp(prefix=SCRATCH, dir=folder))


def recover(folder: str | Path) -> None:
    """Complete an interrupted transaction.

    It is harmless at any time; every reader of a results folder calls it first.

    Raises
    ------
    InputError
        If the folder's manifest cannot be read.
    """
    folder = user_path(folder)
    committed = folder / COMMITTED
    old, new = read_manifest(folder), read_manifest(committed)
    # the new manifest is moved last: until then this can be restarted; if there is none, the new
    # results are in place
    if new is not None:
        for name in new["files"]:
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            _move(committed / name, folder / name)
        for name in sorted(set(old["files"] if old else ()) - set(new["files"])):
            (folder / name).unlink(missing_ok=True)
            # and its parent folders, if empty
            for place in PurePosixPath(name).parents:
                with suppress(OSError):
                    (folder / place).rmdir()
        for name in new["discard"]:
            shutil.rmtree(folder / name, ignore_errors=True)
        _move(committed / MANIFEST, folder / MANIFEST)
    shutil.rmtree(committed, ignore_errors=True)


def _move(source: Path, target: Path) -> None:
    # already moved, before the interruption or by another process that also recovers
    with suppress(FileNotFoundError):
        os.replace(source, target)


def require_apart(folder: Path, inputs: Iterable[str | Path]) -> None:
    """Raise InputError if a run would replace its inputs: results in its folder, or its file."""
    manifest = read_manifest(folder)
    names = manifest["files"] if manifest else ()
    written = {folder.resolve(), *((folder / name).resolve() for name in names)}
    for path in inputs:
        if user_path(path).resolve() in written:
            wrong = f"'{path}' is an input of this run, which would replace it; give another -o"
            raise InputError(wrong)


@contextmanager
def naming_disk(path: Path) -> Iterator[None]:
    """Add the name of the written file to an OSError of the block that has none, or a scratch name.

    HDF5 gives the error number only in its message, and astropy gives none.
    """
    try:
        yield
    except OSError as error:
        number = re.search(r"errno = (\d+)", str(error))
        full = errno.ENOSPC if "Not enough space on disk" in str(error) else None
        code = error.errno or (int(number[1]) if number else full)
        if code is None:
            raise
        named = error.filename and ".partial" not in str(error.filename)
        raise OSError(code, os.strerror(code), error.filename if named else str(path)) from error


@contextmanager
def replacing(path: str | Path) -> Iterator[Path]:
    """Write a single file whole or not at all.

    Yields
    ------
    Path
        A scratch name beside ``path``; the file written there replaces ``path`` after the block. If
        the block fails or is interrupted, the previous file stays unchanged.

    Raises
    ------
    InputError
        If the file cannot be written, or its name belongs to something other than a file.
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
        A scratch folder beside ``folder``, renamed to ``folder`` after the block.

    Raises
    ------
    InputError
        If ``folder`` exists, and as in :func:`require_folder`.
    """
    require_folder(folder)
    if folder.exists():
        raise InputError(f"'{folder}' exists already; give the name of a new folder")
    folder.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=SCRATCH, dir=folder.parent) as scratch:
        # a subfolder, since only the owner may read the scratch folder itself
        stage = Path(scratch) / folder.name
        stage.mkdir()
        yield stage
        os.rename(stage, folder)
