"""What commands have in common: options that mean the same everywhere."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from lusee_bayes.experiment import Experiment
from lusee_bayes.fits_images import is_fits
from lusee_bayes.progress import Stages
from lusee_bayes.scenario import Scenario
from lusee_bayes.visibilities import Visibilities, read_visibilities
from lusee_bayes.waterfall import read_waterfall

Overrides = Annotated[list[str], Parameter(name="--set", negative="")]
Quiet = Annotated[bool, Parameter(name=["--quiet", "-q"], negative="")]
Output = Annotated[Path | None, Parameter(name=["--output", "-o"])]


def prepare(
    scenario: Scenario, data: Path | None, stages: Stages
) -> tuple[Experiment, Visibilities]:
    """The experiment of a scenario with the data of a file, or with its own simulated ones."""
    measured = None if data is None else read_data(data, scenario.frequency_mhz)
    experiment = Experiment.from_scenario(scenario, measured, stages)
    if measured is None:
        with stages("noise"):
            measured = experiment.simulate()
            measured.data.block_until_ready()
    return experiment, measured


def read_data(path: Path, frequency_mhz: float) -> Visibilities:
    """Visibilities of the package's own files, or one channel of luseepy's waterfalls."""
    if path.is_file() and is_fits(path):
        return read_waterfall(path).at(frequency_mhz)
    return read_visibilities(path)
