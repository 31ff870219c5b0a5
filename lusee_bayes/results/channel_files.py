"""Unfinished work of a run of several frequencies: a file for each channel that is done.

``DIR/channels/25.information.nc`` holds what a channel's data say, ``25.result.nc`` its posterior.
So memory stays bounded, and an interrupted run goes on where it was. Files of other scenarios or
data are made anew.
"""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

import xarray as xr

from lusee_bayes.core.files import replacing
from lusee_bayes.core.formats import says
from lusee_bayes.core.version import __version__
from lusee_bayes.experiment.data_files import Data, digest_of
from lusee_bayes.experiment.scenario import Scenario

CHANNELS = "channels"


class ChannelFiles:
    """The files of a run's channels.

    Parameters
    ----------
    folder : Path
        Of the run.
    identity : str
        Of the run (:func:`identity_of`), whose files alone are taken up again.
    """

    def __init__(self, folder: Path, identity: str):
        self.folder = folder / CHANNELS
        self.identity = identity

    def path(self, scenario: Scenario, kind: str) -> Path:
        """Of the ``information`` or the ``result`` of a channel."""
        return self.folder / f"{scenario.frequency_mhz:.15g}.{kind}.nc"

    def has(self, scenario: Scenario, kind: str) -> bool:
        """Whether it is there, whole and of this run."""
        return says(self.path(scenario, kind), {"identity": self.identity})

    def write(self, scenario: Scenario, kind: str, dataset: xr.Dataset) -> None:
        """Write it whole or not at all."""
        with replacing(self.path(scenario, kind)) as partial:
            dataset.assign_attrs(identity=self.identity).to_netcdf(partial, engine="h5netcdf")

    def read(self, scenario: Scenario, kind: str, names: list[str] | None = None) -> xr.Dataset:
        """Read all of it, or some variables."""
        with xr.open_dataset(self.path(scenario, kind), engine="h5netcdf") as file:
            return (file if names is None else file[[n for n in names if n in file]]).load()


def identity_of(scenario: Scenario, data: Data | None, truth: bool, n_draws: int) -> str:
    """Of all that the results of a run depend on: scenario, data, draws, and the package.

    Raises
    ------
    InputError
        If there are no data at the path.
    """
    parts = [scenario.to_yaml(), str(truth), str(n_draws), __version__]
    if data is not None:
        parts.append(digest_of(data))
    return hashlib.sha256(json.dumps(parts).encode()).hexdigest()
