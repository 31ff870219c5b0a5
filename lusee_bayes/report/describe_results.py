"""What info says of results (diagnostics, posteriors, samples) and of runs' folders, as lines."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from lusee_bayes.core import formats
from lusee_bayes.core.errors import InputError
from lusee_bayes.core.files import read_manifest, recover
from lusee_bayes.core.formats import read_netcdf
from lusee_bayes.core.layouts import Layout
from lusee_bayes.core.reading import read_json
from lusee_bayes.results.diagnostics import read_diagnostics
from lusee_bayes.results.finished_runs import Provenance
from lusee_bayes.results.saved import CUBE, POSTERIOR
from lusee_bayes.sampling.datatree import read_datatree


def describe_diagnostics(path: Path) -> list[str]:
    """The diagnostics of a map."""
    found = read_diagnostics(path)
    kinds = found["group_kind"].values
    counts = [f"{int((kinds == kind).sum())} {kind}s" for kind in ("product", "day", "angle")]
    return [
        f"diagnostics of a map at {found.attrs['frequency_mhz']:g} MHz",
        found.attrs["verdict"],
        f"residuals by {', '.join(counts)}; {found.sizes['draw']} draws, "
        f"resolution of {found.sizes['mode']} modes",
    ]


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


def describe_posterior(path: Path) -> list[str]:
    """A posterior at one frequency."""
    found = read_netcdf(path, formats.POSTERIOR, POSTERIOR)
    mean, std, attrs = found.arrays["mean"], found.arrays["std"], found.values
    extra = [name for name in ("truth", "draws", "covariance") if name in found.there]
    draws = found.sizes.get("draw", 0)
    constrained = int((std < 0.5 * found.arrays["prior_std"]).sum())
    return [
        f"posterior over {mean.size} modes (lmax {attrs['lmax']}) at "
        f"{float(attrs['frequency_mhz']):g} MHz, {attrs['frame']}",
        f"mean temperature {mean[0] / np.sqrt(4 * np.pi):.6g} K +- "
        f"{std[0] / np.sqrt(4 * np.pi):.3g} K",
        f"{constrained} modes known to better than half their prior width",
        f"also holds: {', '.join(extra) or 'nothing else'}"
        + (f" ({draws} draws)" if draws else ""),
        f"versions: {attrs['versions']}",
    ]


def describe_posterior_cube(path: Path) -> list[str]:
    """Posteriors at several frequencies."""
    found = read_netcdf(path, formats.POSTERIOR_CUBE, CUBE)
    frequencies, attrs = found.arrays["frequency"], found.values
    temperature = found.arrays["mean"][:, 0] / np.sqrt(4 * np.pi)
    joint, modes = "component_mean" in found.there, found.sizes["mode"]
    extra = [name for name in ("truth", "draws", "independent_mean") if name in found.there]
    kind = "one posterior for all" if joint else "each on its own"
    return [
        f"posterior over {modes} modes (lmax {attrs['lmax']}) at {len(frequencies)} "
        f"frequencies from {frequencies[0]:g} to {frequencies[-1]:g} MHz, {kind}, "
        f"{attrs['frame']}",
        f"mean temperature {temperature[0]:.6g} K to {temperature[-1]:.6g} K",
        *attrs.get("unmapped", "").splitlines(),
        f"also holds: {', '.join(extra) or 'nothing else'}",
        f"versions: {attrs['versions']}",
    ]


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
