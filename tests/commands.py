"""Commands as users give them, and what they leave."""

import csv
import json
import subprocess
import sys
from pathlib import Path

import matplotlib.image
import numpy as np
import xarray as xr

from lusee_bayes.cli.main import main
from lusee_bayes.core.files import LOCK


def run(*arguments: object) -> int:
    """The exit code of a command."""
    return main([str(argument) for argument in arguments])


def python(*arguments: object, check: bool = True, **options) -> subprocess.CompletedProcess:
    """A Python of its own with these arguments, and what it has said."""
    command = [sys.executable, *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, check=check, **options)


def sets(*overrides: str) -> list[str]:
    """Overrides of a scenario as options of a command."""
    return [word for override in overrides for word in ("--set", override)]


def judged_map(data: Path, overrides: list[str], out: Path) -> tuple[np.ndarray, dict[str, object]]:
    """Map data that hold their truth; rho of every ell, and the summary of the channel."""
    command = ["map", "fiducial", "--data", data, "--truth", "-o", out, "--quiet"]
    assert run(*command, *sets(*overrides)) == 0
    rho = np.array([float(row["rho"]) for row in table_of(out / "power_spectra.ecsv")])
    (summary,) = json.loads((out / "summary.json").read_text())["channels"]
    return rho, summary


def refused(capsys, *arguments: object) -> str:
    """The one sentence with which a command ends that refuses its input, with exit code 2."""
    capsys.readouterr()
    assert run(*arguments) == 2
    (sentence,) = capsys.readouterr().err.splitlines()
    assert sentence.startswith("lusee-bayes: ")
    return sentence


def content(folder: Path) -> dict[str, bytes]:
    """Of all files but the lock, which nobody holds once its process is killed."""
    found = (path for path in folder.rglob("*") if path.is_file() and path.name != LOCK)
    return {str(path.relative_to(folder)): path.read_bytes() for path in found}


def assert_drawn(*figures: Path) -> None:
    """Assert that pictures are not blank."""
    for figure in figures:
        assert matplotlib.image.imread(figure).std() > 0.01, figure


def table_of(path: Path) -> list[dict[str, str]]:
    """The rows of a CSV or ECSV file."""
    lines = [line for line in path.read_text().splitlines() if not line.startswith("#")]
    return list(csv.DictReader(lines))


def posterior_of(folder: Path) -> xr.DataTree:
    """What a map run has written."""
    with xr.open_datatree(folder / "posterior.nc", engine="h5netcdf") as tree:
        return tree.load()


def sky_draws_of(folder: Path) -> np.ndarray:
    """Its draws, on (frequency, draw, mode)."""
    sky = posterior_of(folder)["posterior"]["sky"]
    return sky.isel(chain=0).transpose("frequency", "draw", "mode").values
