"""Unfinished work of a run of several frequencies: a file for each channel that is done.

``DIR/channels/25.information.nc`` holds what a channel's data say, ``25.result.nc`` its posterior.
So memory stays bounded, and an interrupted run goes on where it was. Files of other scenarios or
data are made anew. A joint posterior adds up what the files of all channels say.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import xarray as xr
from jaxtyping import Float

from lusee_bayes.core.arrays import on_host
from lusee_bayes.core.engine import Engine, Tasks
from lusee_bayes.core.files import replacing
from lusee_bayes.core.formats import says
from lusee_bayes.core.progress import Stages
from lusee_bayes.core.version import __version__
from lusee_bayes.experiment.data_files import Data, digest_of
from lusee_bayes.experiment.experiment import Experiment
from lusee_bayes.experiment.rounds import Inference
from lusee_bayes.experiment.scenario import Scenario
from lusee_bayes.judge.chi2 import ChiSquare
from lusee_bayes.judge.split import Split
from lusee_bayes.linear.information import Information
from lusee_bayes.linear.joint import ComponentSums, summed_information
from lusee_bayes.results.channel import Observed
from lusee_bayes.results.unknowns import Unknowns
from lusee_bayes.sky.spectral_prior import SpectralPrior

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


# numbers that a file keeps as attributes
OF_INFORMATION = ("misfit", "log_det", "n_data")
OF_CHANNEL = ("frequency_mhz", "n_missing", "rounds")


@dataclass(frozen=True)
class ChannelInformation:
    """What a channel's data say, with what it takes to make a posterior of it and to judge it.

    Attributes
    ----------
    information : Information
    observed : Observed
    sky : (modes,) array
        The scenario's model sky, in K.
    """

    information: Information
    observed: Observed
    sky: Float[np.ndarray, " modes"]

    @classmethod
    def of(
        cls, experiment: Experiment, information: Information, inference: Inference
    ) -> ChannelInformation:
        """Of an experiment and what was inferred from its data."""
        sky, posterior = np.asarray(experiment.setup.sky.modes), inference.posterior
        chi2 = float(information.chi2(posterior.mean) + posterior.prior_chi2())
        split = Split.of(posterior, chi2, inference.model.n_data)
        unknowns = Unknowns.of(experiment, inference, information.reference)
        observed = Observed.of(experiment, inference, split.instrument, unknowns)
        return cls(information, observed, sky)

    def to_dataset(self) -> xr.Dataset:
        """All of it, for :meth:`from_dataset`."""
        information, observed = self.information, self.observed
        variables = {
            "matrix": (("mode", "mode_2"), np.asarray(information.matrix)),
            "vector": ("mode", np.asarray(information.vector)),
            "reference": ("mode", np.asarray(information.reference)),
            "sky": ("mode", self.sky),
            "prior_std": ("mode", observed.prior_std),
            "highest_altitude": ("pixel", observed.highest_altitude),
        }
        if observed.truth is not None:
            variables["truth"] = ("mode", observed.truth)
        numbers = {name: float(getattr(information, name)) for name in OF_INFORMATION}
        numbers |= {name: getattr(observed, name) for name in OF_CHANNEL}
        numbers |= asdict(observed.instrument)
        found = xr.Dataset(variables, attrs={**numbers, "doubts": json.dumps(observed.doubts)})
        if observed.unknowns is None:
            return found
        own = observed.unknowns.to_dataset()
        return found.merge(own).assign_attrs(own.attrs)

    @classmethod
    def from_dataset(cls, dataset: xr.Dataset) -> ChannelInformation:
        """The inverse of :meth:`to_dataset`."""
        arrays = {str(name): np.asarray(values) for name, values in dataset.data_vars.items()}
        information = Information(
            *(arrays[name] for name in ("matrix", "vector", "reference")),
            *(np.asarray(float(dataset.attrs[name])) for name in OF_INFORMATION),
        )
        observed = Observed(
            float(dataset.attrs["frequency_mhz"]),
            arrays["prior_std"],
            arrays.get("truth"),
            arrays["highest_altitude"],
            int(dataset.attrs["n_missing"]),
            int(dataset.attrs["rounds"]),
            ChiSquare(float(dataset.attrs["chi2"]), float(dataset.attrs["degrees"])),
            tuple(json.loads(dataset.attrs["doubts"])),
            Unknowns.from_dataset(dataset, arrays["reference"]),
        )
        return cls(information, observed, arrays["sky"])


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
    return ChannelInformation.from_dataset(files.read(channel, "information")).information
