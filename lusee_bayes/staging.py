"""Results that are written whole or not at all."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from lusee_bayes.checks import InputError


def require_folder(folder: Path) -> None:
    """InputError if ``folder``, or what it would lie in, is a file."""
    for place in (folder, *folder.parents):
        if place.exists():
            if not place.is_dir():
                raise InputError(f"'{place}' is a file; give a folder for the results")
            return


@contextmanager
def staged(folder: str | Path) -> Iterator[Path]:
    """A scratch folder inside ``folder`` whose files replace the old ones only when all are done.

    If anything fails or is interrupted before that, the previous files stay as they were.
    """
    folder = Path(folder)
    require_folder(folder)
    folder.mkdir(parents=True, exist_ok=True)
    stage = Path(tempfile.mkdtemp(prefix=".partial-", dir=folder))
    try:
        yield stage
        for item in sorted(stage.iterdir()):
            target = folder / item.name
            if item.is_dir():
                target.mkdir(exist_ok=True)
                for inner in sorted(item.iterdir()):
                    os.replace(inner, target / inner.name)
            else:
                os.replace(item, target)
    finally:
        shutil.rmtree(stage, ignore_errors=True)


@contextmanager
def replacing(path: str | Path) -> Iterator[Path]:
    """A scratch name beside ``path``; what is written there takes its place when all is done.

    If anything fails or is interrupted before that, the previous file stays as it was.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".{path.name}.{os.getpid()}.partial")
    try:
        yield partial
        os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)
