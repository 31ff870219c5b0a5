"""Where results go: refused before anything is computed, if nothing could be written there."""

from __future__ import annotations

import fcntl
import os
import socket
import stat
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

from lusee_bayes.core.errors import InputError
from lusee_bayes.core.paths import user_path

# held while a run works in a folder; says whose it is
LOCK = ".lock"


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
    for place in (folder, *folder.absolute().parents):
        mode = _mode(place)
        if mode is None:
            continue
        if not stat.S_ISDIR(mode):
            kind = "a file" if stat.S_ISREG(mode) else "neither a file nor a folder"
            raise InputError(f"'{place}' is {kind}; give a folder for the results")
        _require_writable(place)
        return


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
    mode = _mode(path)
    if not path.name or (mode is not None and stat.S_ISDIR(mode)):
        raise InputError(f"'{path}' is a folder; give the name of a file for the results")
    if mode is not None and not stat.S_ISREG(mode):
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
        raise InputError(f"'{path}' is there already; give -o another name, or --force")


def _require_name(path: Path) -> None:
    if "\0" in str(path) or not str(path):
        raise InputError(f"'{path!s}' is no name of a file; give one without NUL characters")


def _mode(path: Path) -> int | None:
    """What is at a path; None if nothing is. A link to nothing is something that cannot be used."""
    try:
        return path.stat().st_mode
    except (FileNotFoundError, NotADirectoryError):
        if path.is_symlink():
            raise InputError(f"'{path}' is a link that leads nowhere; remove it") from None
        return None
    except OSError as error:
        raise InputError(f"'{path}' cannot be used for the results: {error.strerror}") from error


def _require_writable(place: Path) -> None:
    try:
        # a file without a name: whatever happens, nothing of it is left
        tempfile.TemporaryFile(dir=place).close()
    except OSError as error:
        raise InputError(
            f"nothing can be written into '{place}': {error.strerror}; give another folder"
        ) from error


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Keep other runs out of a folder, which is there, during the block.

    The lock ends with the process, however that ends.

    Raises
    ------
    InputError
        If another run works in it.
    """
    path = folder / LOCK
    while True:
        handle = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            owner = os.read(handle, 200).decode(errors="replace").strip() or "another process"
            os.close(handle)
            raise InputError(
                f"another run works in '{folder}' ({owner}); wait for it, or give another folder"
            ) from error
        # the one before may have removed the file between the two steps
        if path.exists() and os.fstat(handle).st_ino == path.stat().st_ino:
            break
        os.close(handle)
    try:
        os.truncate(handle, 0)
        os.write(handle, f"process {os.getpid()} on {socket.gethostname()}".encode())
        yield
    finally:
        path.unlink(missing_ok=True)
        os.close(handle)
