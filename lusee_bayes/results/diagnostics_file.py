"""diagnostics.nc: written and read."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import xarray as xr

from lusee_bayes.core import formats
from lusee_bayes.core.errors import InputError
from lusee_bayes.core.formats import read_dataset
from lusee_bayes.judge.residuals import Group
from lusee_bayes.results.saved import DIAGNOSTICS


def write_diagnostics(dataset: xr.Dataset, path: Path) -> None:
    """Write to netCDF; maps of draws and shares in single precision."""
    if not dataset.sizes["group"]:  # files hold no empty arrays
        dataset = dataset.drop_dims("group")
    encoding = {name: {"dtype": "float32"} for name in ("draws", "prior_fraction")}
    dataset.to_netcdf(path, engine="h5netcdf", encoding=encoding)


def read_diagnostics(path: str | Path) -> xr.Dataset:
    """What :func:`write_diagnostics` wrote. InputError for anything else."""
    found = read_dataset(path, formats.DIAGNOSTICS, DIAGNOSTICS, "lusee-bayes map writes one")
    empty = group_variables(())
    if "group" not in found.sizes:
        return found.assign(empty)
    # files hold no empty arrays, so that all are absent, or none
    missing = sorted(empty.keys() - found.keys())
    if missing:
        raise InputError(f"{path} has groups without {missing[0]}; lusee-bayes map writes them")
    return found


# what is told of a group of data
GROUP = {"kind": np.str_, "name": np.str_, "n": np.int64} | dict.fromkeys(
    ("degrees", "chi2", "p", "others_p"), np.float64
)


def group_variables(groups: Sequence[Group]) -> dict[str, tuple[str, np.ndarray]]:
    """One row for every group that was left out."""
    return {
        f"group_{name}": ("group", np.array([getattr(g, name) for g in groups], dtype=dtype))
        for name, dtype in GROUP.items()
    }
