"""What info says of samples and of the folders of runs."""

from __future__ import annotations

from pathlib import Path

from lusee_bayes.core.errors import InputError
from lusee_bayes.core.files import read_manifest, recover
from lusee_bayes.core.layouts import Layout
from lusee_bayes.core.reading import read_json
from lusee_bayes.results.finished_runs import Provenance
from lusee_bayes.sampling.datatree import read_datatree

FIGURES = ("summary.json", "sampling.json", "priors.json")


def describe_folder(folder: Path) -> list[str]:
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
    lines = [f"results of lusee-bayes {manifest['kind']}"]
    found = Provenance.read(folder)
    if found is not None:
        lines += [
            f"data: {found.data_line()}",
            f"{found.first} to {found.last} UTC, {found.n_times} times, site {found.lon_deg:g}, "
            f"{found.lat_deg:g} degrees",
            f"up to ell = {found.lmax}; made {found.made} UTC by lusee_bayes {found.version}",
        ]
        lines += [f"command: {found.command}"] if found.command else []
    for name in FIGURES:
        if (folder / name).is_file():
            figures = read_json(folder / name, Layout("the figures of a run"))
            lines += [str(figures["verdict"])] if "verdict" in figures else []
    names = sorted(str(name) for name in manifest["files"])
    return [*lines, f"files: {', '.join(names)}"]


def describe_samples(path: Path) -> list[str]:
    """Draws of a program."""
    tree = read_datatree(path)
    posterior, statistics = tree["posterior"], tree["sample_stats"]
    sites = ", ".join(f"{name} {v.shape[2:]}" for name, v in posterior.data_vars.items())
    return [
        f"{posterior.sizes['chain']} x {posterior.sizes['draw']} draws of the program "
        f"{tree.attrs['program']} at {float(tree.attrs['frequency_mhz']):g} MHz",
        f"sites: {sites}",
        f"{int(statistics['diverging'].sum())} divergences, "
        f"{float(statistics['n_steps'].mean()):.1f} steps a trajectory",
        f"groups: {', '.join(tree.children)}",
    ]
