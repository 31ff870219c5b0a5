"""The channels of a joint posterior, in the files of a run, and sums over them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from lusee_bayes.core.arrays import on_host
from lusee_bayes.core.engine import Engine, Tasks
from lusee_bayes.core.progress import Stages
from lusee_bayes.experiment.scenario import Scenario
from lusee_bayes.linear.information import Information
from lusee_bayes.linear.joint import ComponentSums, summed
from lusee_bayes.results.channel_files import ChannelFiles
from lusee_bayes.results.channel_information import ChannelInformation
from lusee_bayes.sky.spectral_prior import SpectralPrior

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
                sums = summed(sums, prior, number, information)
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
