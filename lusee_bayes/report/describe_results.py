"""What info says of results (diagnostics, posteriors, samples) and of runs' folders, as lines."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from lusee_bayes.core import formats
from lusee_bayes.core.formats import read_netcdf
from lusee_bayes.results.diagnostics_file import read_diagnostics
from lusee_bayes.results.saved import CUBE, POSTERIOR


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
