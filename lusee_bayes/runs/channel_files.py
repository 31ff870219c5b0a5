"""Unfinished work of a run of several frequencies: a file for each channel that is done.

``DIR/channels/25.information.nc`` holds what a channel's data say, ``25.result.nc`` its posterior.
So memory stays bounded, and an interrupted run goes on where it was. Files of other scenarios or
data are made anew. A joint posterior adds up what the files of all channels say.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import xarray as xr
from jaxtyping import Float

from lusee_bayes.core.arrays import on_host
from lusee_bayes.core.engine import Engine, Tasks
from lusee_bayes.core.files import replacing
from lusee_bayes.core.formats import says
from lusee_bayes.core.progress import Stages
from lusee_bayes.core.trees import from_tree, to_tree
from lusee_bayes.core.version import __version__
from lusee_bayes.experiment.data_files import Data, digest_of
from lusee_bayes.experiment.scenario import Scenario
from lusee_bayes.experiment.unknowns import Unknowns
from lusee_bayes.linear.information import Information
from lusee_bayes.linear.joint import ComponentSums, summed_information
from lusee_bayes.results.channel import ChannelData
from lusee_bayes.sky.spectral_prior import SpectralPrior

T = TypeVar("T")
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

    def write(self, scenario: Scenario, kind: str, value: Any) -> None:
        """Write a dataclass whole or not at all."""
        with replacing(self.path(scenario, kind)) as partial:
            tree = to_tree(value)
            tree.attrs["identity"] = self.identity
            tree.to_netcdf(partial, engine="h5netcdf")

    def read(self, scenario: Scenario, kind: str, of: type[T], part: str = "/") -> T:
        """Read what was written, or a part of it by its path."""
        path = self.path(scenario, kind)
        with xr.open_datatree(path, engine="h5netcdf") as tree:
            return from_tree(of, tree[part], str(path))

    def arrays(self, scenario: Scenario, kind: str, *names: str) -> list[np.ndarray]:
        """Read some arrays of it, by their paths."""
        with xr.open_datatree(self.path(scenario, kind), engine="h5netcdf") as tree:
            return [np.asarray(tree[name]) for name in names]


def identity_of(scenario: Scenario, data: Data | None, *others: object) -> str:
    """Of all that the results of a run depend on: scenario, data, others, and the package.

    Raises
    ------
    InputError
        If there are no data at the path.
    """
    parts = [scenario.to_yaml(), *map(str, others), __version__]
    if data is not None:
        parts.append(digest_of(data))
    return hashlib.sha256(json.dumps(parts).encode()).hexdigest()


@dataclass(frozen=True)
class ChannelInformation:
    """What a channel's data say, with what it takes to make a posterior of it and to judge it.

    Attributes
    ----------
    information : Information
    known : ChannelData
    unknowns : Unknowns or None
        Receivers, ground and gain table given the sky, where the model has them.
    sky : (modes,) array
        The scenario's model sky, in K.
    """

    information: Information
    known: ChannelData
    unknowns: Unknowns | None
    sky: Float[np.ndarray, " mode"]


# channels that one task adds up, one after the other
BLOCK = 4


@dataclass(frozen=True)
class ChannelsInFiles:
    """Channels whose information is read from files, by whatever carries out the tasks.

    Attributes
    ----------
    channels : tuple of Scenario
        Of the whole run.
    files : ChannelFiles
        With the information of every channel.
    engine : Engine
    stages : Stages
        Told what is being done.
    """

    channels: tuple[Scenario, ...]
    files: ChannelFiles
    engine: Engine
    stages: Stages

    def each(
        self,
        function: Callable[[int, Information], dict[str, np.ndarray]],
        shapes: dict[str, tuple[int, ...]],
    ) -> dict[str, np.ndarray]:
        """Call a function with number and information of every channel; its arrays, stacked."""
        files, channels = self.files, self.channels

        def call(number: int) -> dict[str, np.ndarray]:
            return function(number, _information(files, channels[number]))

        numbers = range(len(channels))
        tasks = Tasks(call, numbers, [names_of(channels[k : k + 1]) for k in numbers])
        found = self.engine.each(tasks, self.stages, "joint sums")
        return {name: np.stack([np.asarray(one[name]) for one in found]) for name in shapes}

    def summed(
        self,
        prior: SpectralPrior,
        reference: Float[np.ndarray, "channels modes"],
        function: Callable[[int, Information], Information],
    ) -> Information:
        """What a function of every channel's information says of the component maps."""
        files, channels = self.files, self.channels

        def add(numbers: range) -> ComponentSums:
            sums = ComponentSums.empty(prior, reference)
            for number in numbers:
                information = function(number, _information(files, channels[number]))
                sums = summed_information(sums, prior, number, information)
            return on_host(sums)

        # the same blocks, and the same tree of them, whatever carries out the tasks
        blocks = [
            range(first, min(first + BLOCK, len(channels)))
            for first in range(0, len(channels), BLOCK)
        ]
        names = [names_of(channels[block.start : block.stop]) for block in blocks]
        tasks = Tasks(add, blocks, names)
        return self.engine.reduced(
            tasks, ComponentSums.plus, self.stages, "joint sums"
        ).information()


def names_of(channels: tuple[Scenario, ...]) -> str:
    """What one channel, or neighbouring ones, are called: 25 MHz, or 25 to 28 MHz."""
    first, last = (f"{c.frequency_mhz:g}" for c in (channels[0], channels[-1]))
    return f"{first} MHz" if len(channels) == 1 else f"{first} to {last} MHz"


def _information(files: ChannelFiles, channel: Scenario) -> Information:
    return files.read(channel, "information", Information, "information")
