"""The channels of a joint posterior, in the files of a run that several processes may share."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from threading import get_ident

import jax
import numpy as np
from jaxtyping import Float

from lusee_bayes.core.process_group import ProcessGroup
from lusee_bayes.core.progress import Stages
from lusee_bayes.experiment.scenario import Scenario
from lusee_bayes.linear.information import Information
from lusee_bayes.linear.joint import ComponentSums, summed
from lusee_bayes.results.channel_files import ChannelFiles
from lusee_bayes.results.channel_information import ChannelInformation
from lusee_bayes.results.channel_threads import each_channel
from lusee_bayes.sky.spectral_prior import SpectralPrior


@dataclass(frozen=True)
class ChannelsInFiles:
    """Channels whose information is read from files, each by the process that it belongs to.

    Attributes
    ----------
    channels : tuple of Scenario
        Of the whole run.
    files : ChannelFiles
        With the information of every channel.
    group : ProcessGroup
    stages : Stages
        Told what is being done.
    """

    channels: tuple[Scenario, ...]
    files: ChannelFiles
    group: ProcessGroup
    stages: Stages

    def read(self, channel: int) -> Information:
        """What the data of a channel say."""
        dataset = self.files.read(self.channels[channel], "information")
        return ChannelInformation.from_dataset(dataset).information

    def each(
        self,
        function: Callable[[int, Information], dict[str, np.ndarray]],
        shapes: dict[str, tuple[int, ...]],
    ) -> dict[str, np.ndarray]:
        """Call a function with number and information of every channel; its arrays, stacked."""
        found = {name: np.zeros((len(self.channels), *shape)) for name, shape in shapes.items()}

        def call(number: int) -> None:
            for name, value in function(number, self.read(number)).items():
                found[name][number] = value

        self._each(call)
        return {name: self.group.total(array) for name, array in found.items()}

    def summed(
        self,
        prior: SpectralPrior,
        reference: Float[np.ndarray, "channels modes"],
        function: Callable[[int, Information], Information],
    ) -> Information:
        """What a function of every channel's information says of the component maps."""
        start = ComponentSums.empty(prior, reference)
        by_thread: dict[int, ComponentSums] = {}

        def add(number: int) -> None:
            information = function(number, self.read(number))
            # every thread has sums of its own, on its device
            before = by_thread.get(get_ident())
            if before is None:
                before = ComponentSums.empty(prior, reference)
            by_thread[get_ident()] = jax.block_until_ready(
                summed(before, prior, number, information)
            )

        self._each(add)
        leaves, shape = jax.tree.flatten(start)
        # with the empty ones: a process may have no channels
        parts = [jax.tree.leaves(sums) for sums in (start, *by_thread.values())]
        # everything but the maps that all is written about is a sum
        whole = [
            leaf
            if leaf is start.reference
            else self.group.total(np.asarray(sum(np.asarray(part[k]) for part in parts)))
            for k, leaf in enumerate(leaves)
        ]
        return jax.tree.unflatten(shape, whole).information()

    def _each(self, function: Callable[[int], None]) -> None:
        number = {channel.frequency_mhz: k for k, channel in enumerate(self.channels)}
        each_channel(
            lambda channel: function(number[channel.frequency_mhz]),
            self.channels,
            self.group,
            self.stages,
            "joint sums",
        )
