"""What is in the folder of a finished run."""

from __future__ import annotations

from pathlib import Path

from lusee_bayes.core.errors import InputError
from lusee_bayes.core.files import read_manifest, recover
from lusee_bayes.core.layouts import Layout
from lusee_bayes.core.reading import read_json
from lusee_bayes.results.provenance import Provenance

FIGURES = ("summary.json", "sampling.json", "priors.json")


def describe_folder(folder: Path) -> str:
    """A finished run: its kind, where it comes from, its verdict, its files.

    Raises
    ------
    InputError
        If no run has written the folder.
    """
    recover(folder)
    manifest = read_manifest(folder)
    if manifest is None:
        raise InputError(
            f"'{folder}' is a folder that no run has written: it has no manifest.json; give a file "
            "or the folder of a finished run"
        )
    lines = [f"{folder}: results of lusee-bayes {manifest['kind']}"]
    found = Provenance.read(folder)
    if found is not None:
        lines += [
            f"  data: {found.data_line()}",
            f"  {found.first} to {found.last} UTC, {found.n_times} times, site {found.lon_deg:g}, "
            f"{found.lat_deg:g} degrees",
            f"  up to ell = {found.lmax}; made {found.made} UTC by lusee_bayes {found.version}",
        ]
        lines += [f"  command: {found.command}"] if found.command else []
    for name in FIGURES:
        if (folder / name).is_file():
            figures = read_json(folder / name, Layout("the figures of a run"))
            lines += [f"  {figures[key]}" for key in ("verdict",) if key in figures]
    names = sorted(str(name) for name in manifest["files"])
    return "\n".join([*lines, f"  files: {', '.join(names)}"])
