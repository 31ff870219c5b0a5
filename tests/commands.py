"""Commands as users give them, and what they leave."""

from __future__ import annotations

from pathlib import Path

import xarray as xr

from lusee_bayes.cli.main import main
from lusee_bayes.core.files import LOCK


def run(*arguments: object) -> int:
    """The exit code of a command."""
    return main([str(argument) for argument in arguments])


def content(folder: Path) -> dict[str, bytes]:
    """Of all files but the lock, which nobody holds once its process is killed."""
    found = (path for path in folder.rglob("*") if path.is_file() and path.name != LOCK)
    return {str(path.relative_to(folder)): path.read_bytes() for path in found}


def posterior_of(folder: Path) -> xr.Dataset:
    """What a map run has written."""
    return xr.load_dataset(folder / "posterior.nc", engine="h5netcdf")
