"""Export of finished runs as folders to publish, for readers without the package.

A folder has the run's files, checksums, DataCite metadata, a licence and a reader. Templates for
its texts are in ``report/templates/release``.
"""

import shutil
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path

import h5py
import numpy as np

from lusee_bayes.core import files
from lusee_bayes.core.errors import InputError
from lusee_bayes.core.reading import parse_yaml, read_text
from lusee_bayes.core.version import __version__
from lusee_bayes.experiment.data_files import digest_of
from lusee_bayes.report.describe import describe_folder
from lusee_bayes.report.rendering import render_text
from lusee_bayes.results.finished_runs import NAME, FinishedRun, Provenance
from lusee_bayes.runs.folder import RunOutcome

# map files for one frequency, and for several
MAPS = {"map.fits", "mean.fits"}
BLANK = "TO BE FILLED IN"
METADATA, SUMS = "datacite.json", "SHA256SUMS"
TEXTS = (METADATA, "LICENSE", "README.md", "read_it.py")


def run_export(
    run: str | Path,
    folder: str | Path,
    *,
    creators: Sequence[str] = (),
    doi: str = "",
    licence: str = "CC-BY-4.0",
) -> RunOutcome[list[str]]:
    """Bundle a finished run for publication, completely or not at all.

    Parameters
    ----------
    run : path
        Folder of a finished run of ``map``, ``sample`` (of one frequency) or ``validate``.
    folder : path
        Folder of the release, which must not exist. All files are at its top level, because
        archives have no folders; ``report.html`` contains the figures.
    creators : sequence of str
        ``"Family, Given"``, or the name of a group.
    doi : str
        DOI of the release, if known.
    licence : str
        ``CC-BY-4.0`` or ``CC0-1.0``.

    Returns
    -------
    RunOutcome
        Its result lists the entries still missing from ``datacite.json``. This file is meant to be
        edited, and is not in ``SHA256SUMS``.

    Raises
    ------
    InputError
        If ``run`` is not the folder of such a run or lacks a file, if ``folder`` exists already, or
        if ``doi`` is not a DOI.
    """
    run, folder = files.user_path(run), files.user_path(folder)
    (_, *lines, _), manifest = describe_folder(run), files.read_manifest(run)
    names = [name for name in manifest["files"] if "/" not in name]
    if NAME not in names or not MAPS & {*names}:
        raise InputError(f"'{run}' has no map; give the folder of a run of map, sample or validate")
    files.require_files(run, names, manifest["kind"])
    if doi and not (doi.startswith("10.") and "/" in doi):
        raise InputError(f"'{doi}' is not a DOI; give it without https, such as 10.5281/zenodo.1")
    scenario = parse_yaml(read_text(run / "scenario.yaml", "a scenario"), "scenario.yaml")
    origin = {"lines": lines, "scenario": scenario, "provenance": Provenance.read(run)}
    given = {"creators": creators or [BLANK], "doi": doi or BLANK, "licence": licence}
    context = origin | given | {"names": names, "year": datetime.now(UTC).year}
    with files.new_folder(folder) as stage:
        for name in names:
            shutil.copyfile(run / name, stage / name)
        for name in TEXTS:
            text = render_text(f"release/{name}.jinja", **context)
            (stage / name).write_text(text, encoding="utf-8")
        summed = sorted({*names, *TEXTS} - {METADATA})
        sums = "".join(f"{digest_of(stage / name)}  {name}\n" for name in summed)
        (stage / SUMS).write_text(sums, encoding="utf-8")
    blanks = [name for name, value in {"creators": creators, "doi": doi}.items() if not value]
    return RunOutcome(blanks, folder, [folder / name for name in (*summed, METADATA, SUMS)])


def write_skyh5(run: str | Path, path: str | Path) -> RunOutcome[list[str]]:
    """Write the posterior mean of a map run for pyradiosky.

    Parameters
    ----------
    run : path
        Folder of a finished run of ``map``, with one or several frequencies.
    path : path
        The SkyH5 file: HEALPix, RING, Galactic, Stokes I in K.

    Raises
    ------
    InputError
        If ``run`` is not the folder of a map run.
    """
    finished, path = FinishedRun.read(run), files.user_path(path)
    files.require_new(path, replace=False)
    stokes_i = np.stack([channel.maps()["mean"] for channel in finished.channels])
    text = {"component_type": "healpix", "spectral_type": "full", "hpx_order": "ring"}
    text |= {"hpx_frame/frame": "galactic", "history": f"lusee_bayes {__version__}: {run}"}
    content = {f"Header/{name}": np.bytes_(value) for name, value in text.items()} | {
        "Header/Ncomponents": stokes_i.shape[1],
        "Header/Nfreqs": len(stokes_i),
        "Header/freq_array": [1e6 * channel.frequency_mhz for channel in finished.channels],
        "Header/hpx_inds": np.arange(stokes_i.shape[1]),
        "Header/nside": finished.channel.nside,
        # I, Q, U, V
        "Data/stokes": np.stack([stokes_i, *np.zeros((3, *stokes_i.shape))]),
    }
    units = {"Header/freq_array": "Hz", "Data/stokes": "K"}
    with files.replacing(path) as partial, h5py.File(partial, "w") as file:
        for name, value in content.items():
            file[name] = value
            if name in units:
                file[name].attrs["unit"] = units[name]
    return RunOutcome([], path.parent, [path])
