"""What is in visibilities and waterfalls."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float

from lusee_bayes.instrument.products import labels
from lusee_bayes.instrument.visibilities import Visibilities
from lusee_bayes.instrument.visibilities_file import read_visibilities
from lusee_bayes.instrument.waterfalls import read_waterfall


def describe_visibilities(path: Path) -> str:
    """Visibilities at one frequency."""
    data = read_visibilities(path)
    observation = data.observation
    grid = data.grid()
    autos = grid[[k for k, label in enumerate(data.labels) if label[0] == label[1]]]
    return "\n".join(
        [
            f"{path}: visibilities at {data.frequency_mhz:g} MHz",
            f"  {data.layout.n_products} products ({data.labels[0]} ... {data.labels[-1]}), "
            f"{data.layout.n_times} times of {observation.step_s:g} s, {data.n_missing} samples "
            "missing",
            f"  {_windows(data)}",
            f"  {observation.times[0].isot} to {observation.times[-1].isot} UTC, "
            f"{observation.n_runs} run(s) at turntable {observation.turntable_deg} degrees",
            f"  site: longitude {observation.lon_deg}, latitude {observation.lat_deg} degrees",
            f"  autos {np.nanmin(autos):.4g} to {np.nanmax(autos):.4g} K",
            f"  true sky {'included' if data.truth is not None else 'not known'}",
        ]
    )


def _windows(data: Visibilities) -> str:
    """What its times are."""
    windows = data.observation.windows
    if not data.says_window:
        return "the file does not say what its times are: --set observation.timestamp=..."
    if windows is None:
        return "times are instants"
    bounds, live = windows.bounds_s, windows.live_per_sample_s
    length = bounds[:, 1] - bounds[:, 0]
    several = len(windows.sample) - windows.n_samples
    in_pieces = f" in {len(windows.sample)} pieces" if several else ""
    return (
        f"times are middles of windows of {_range(length)} s{in_pieces}, live for "
        f"{live.sum() / length.sum():.1%} of them"
    )


def _range(values: Float[np.ndarray, " samples"]) -> str:
    low, high = (f"{x:.6g}" for x in (values.min(), values.max()))
    return low if low == high else f"{low} to {high}"


def describe_waterfall(path: Path) -> str:
    """A waterfall of luseepy."""
    waterfall = read_waterfall(path)
    grid, observation = waterfall.grid, waterfall.observation
    four_port = waterfall.per_kelvin is not None
    here = ~np.isnan(grid).all((1, 2))
    names = [name for name, there in zip(labels(), here, strict=True) if there]
    gaps = int(np.isnan(grid[here]).sum())
    four_port_lines = []
    if four_port:
        kelvin = waterfall.per_kelvin
        four_port_lines = [
            f"  in V^2/Hz: 1 K is {kelvin.min():.4g} to {kelvin.max():.4g} of them",
            f"  with the emission of the Moon at {waterfall.moon_k:.15g} K",
        ]
    return "\n".join(
        [
            f"{path}: a waterfall of luseepy" + (", four ports" if four_port else ""),
            f"  channels at {', '.join(f'{f:.9g}' for f in waterfall.frequencies_mhz)} MHz",
            f"  {len(names)} products ({' '.join(names)}), {observation.n_times} times of "
            f"{observation.step_s:g} s, {gaps} samples missing",
            "  times are instants, unless observation.timestamp says otherwise",
            f"  {observation.times[0].isot} to {observation.times[-1].isot} UTC",
            f"  site: longitude {observation.lon_deg}, latitude {observation.lat_deg} degrees",
            *four_port_lines,
        ]
    )
