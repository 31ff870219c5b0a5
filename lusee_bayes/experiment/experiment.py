"""An experiment: a setup and the data that were taken with it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from lusee_bayes.core.progress import Stages
from lusee_bayes.core.representation import Described
from lusee_bayes.experiment.model import radiometer
from lusee_bayes.experiment.plausibility import require_plausible
from lusee_bayes.experiment.scenario import Scenario
from lusee_bayes.experiment.setup import Setup, set_up
from lusee_bayes.experiment.simulate import simulate
from lusee_bayes.instrument.visibilities import Visibilities


@dataclass(frozen=True, repr=False)
class Experiment(Described):
    """The pieces of d = A m + n, with d. :func:`build` makes one of a scenario.

    Attributes
    ----------
    setup : Setup
        A, S, the model sky and what N is made of.
    data : Visibilities
        d, measured or simulated.
    doubts : tuple of str
        What is doubtful about measured data, a sentence each.
    """

    setup: Setup
    data: Visibilities
    doubts: tuple[str, ...] = ()

    def description(self) -> tuple[str, ...]:
        scenario = self.scenario
        return (
            f"{scenario.frequency_mhz:g} MHz, lmax = {scenario.lmax}, beams {scenario.beam.label}",
            *self.data.description(),
        )

    @property
    def scenario(self) -> Scenario:
        """What the experiment was built of."""
        return self.setup.scenario


def build(
    scenario: Scenario, data: Visibilities | None = None, stages: Stages | None = None
) -> Experiment:
    """Build the experiment of a scenario.

    Parameters
    ----------
    scenario : Scenario
        Of one frequency.
    data : Visibilities, optional
        Measured data; without them the scenario's own are simulated.
    stages : Stages, optional
        Told what is being done.

    Raises
    ------
    InputError
        If the data are of another frequency, another site or other ports, and for data that no
        sky gives (:func:`.require_plausible`).
    """
    stages = stages or Stages()
    setup = set_up(scenario, data, stages)
    if data is None:
        with stages("noise"):
            return Experiment(setup, simulate(setup))
    std = np.sqrt(np.asarray(radiometer(setup).diagonal()))
    doubts = require_plausible(data, setup.signal, std)
    for doubt in doubts:
        stages.say(f"  doubtful: {doubt}")
    return Experiment(setup, data, doubts)


def with_truth(experiment: Experiment) -> Experiment:
    """The same, its data being of the scenario's own sky."""
    data = replace(experiment.data, truth=experiment.setup.sky.modes)
    return replace(experiment, data=data)
