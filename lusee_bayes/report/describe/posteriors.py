"""What is in posteriors over the sky."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import xarray as xr


def describe_posterior(path: Path) -> str:
    """A posterior at one frequency."""
    with xr.open_dataset(path, engine="h5netcdf") as posterior:
        mean, std = posterior["mean"].values, posterior["std"].values
        attrs = posterior.attrs
        extra = [name for name in ("truth", "draws", "covariance") if name in posterior]
        draws = posterior.sizes.get("draw", 0)
    constrained = int((std < 0.5 * posterior["prior_std"].values).sum())
    return "\n".join(
        [
            f"{path}: posterior over {mean.size} modes (lmax {attrs['lmax']}) at "
            f"{float(attrs['frequency_mhz']):g} MHz, {attrs['frame']}",
            f"  mean temperature {mean[0] / np.sqrt(4 * np.pi):.6g} K +- "
            f"{std[0] / np.sqrt(4 * np.pi):.3g} K",
            f"  {constrained} modes known to better than half their prior width",
            f"  also holds: {', '.join(extra) or 'nothing else'}"
            + (f" ({draws} draws)" if draws else ""),
            f"  versions: {attrs['versions']}",
        ]
    )


def describe_posterior_cube(path: Path) -> str:
    """Posteriors at several frequencies."""
    with xr.open_dataset(path, engine="h5netcdf") as posterior:
        frequencies, attrs = posterior["frequency"].values, posterior.attrs
        temperature = posterior["mean"].values[:, 0] / np.sqrt(4 * np.pi)
        joint = "component_mean" in posterior
        extra = [name for name in ("truth", "draws", "independent_mean") if name in posterior]
        modes = posterior.sizes["mode"]
    kind = "one posterior for all" if joint else "each by itself"
    return "\n".join(
        [
            f"{path}: posterior over {modes} modes (lmax {attrs['lmax']}) at {len(frequencies)} "
            f"frequencies from {frequencies[0]:g} to {frequencies[-1]:g} MHz, {kind}, "
            f"{attrs['frame']}",
            f"  mean temperature {temperature[0]:.6g} K to {temperature[-1]:.6g} K",
            f"  also holds: {', '.join(extra) or 'nothing else'}",
            f"  versions: {attrs['versions']}",
        ]
    )
