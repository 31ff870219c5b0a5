"""diagnostics.nc: written and read."""

from __future__ import annotations

from pathlib import Path

import xarray as xr

from lusee_bayes.core import formats
from lusee_bayes.core.netcdf_files import read_dataset
from lusee_bayes.results.saved import DIAGNOSTICS


def write_diagnostics(dataset: xr.Dataset, path: Path) -> None:
    """Write to netCDF; maps of draws and shares in single precision."""
    encoding = {name: {"dtype": "float32"} for name in ("draws", "prior_fraction")}
    dataset.to_netcdf(path, engine="h5netcdf", encoding=encoding)


def read_diagnostics(path: str | Path) -> xr.Dataset:
    """What :func:`write_diagnostics` wrote. InputError for anything else."""
    return read_dataset(path, formats.DIAGNOSTICS, DIAGNOSTICS, "lusee-bayes map writes one")
