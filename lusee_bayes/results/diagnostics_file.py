"""diagnostics.nc: written and read."""

from __future__ import annotations

from pathlib import Path

import xarray as xr

from lusee_bayes.core import formats
from lusee_bayes.core.netcdf_files import read_dataset
from lusee_bayes.results.saved import DIAGNOSTICS

# point-spread functions are kept in units of this part of their peak
KERNEL_STEP = 1.0 / 127.0


def write_diagnostics(dataset: xr.Dataset, path: Path) -> None:
    """Write to netCDF; point-spread functions with a byte for each value, of their peak."""
    byte = {"dtype": "int8", "scale_factor": KERNEL_STEP, "_FillValue": -128, "zlib": True}
    single = {name: {"dtype": "float32"} for name in ("draws", "prior_fraction")}
    dataset.to_netcdf(path, engine="h5netcdf", encoding={"psf": byte, **single})


def read_diagnostics(path: str | Path) -> xr.Dataset:
    """What :func:`write_diagnostics` wrote. InputError for anything else."""
    return read_dataset(path, formats.DIAGNOSTICS, DIAGNOSTICS, "lusee-bayes map writes one")
