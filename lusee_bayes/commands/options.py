"""What commands have in common: options that mean the same everywhere."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from typing import Annotated

import numpy as np
from cyclopts import Parameter

from lusee_bayes.checks import InputError
from lusee_bayes.data_files import read_data
from lusee_bayes.experiment import Experiment
from lusee_bayes.progress import Stages
from lusee_bayes.scenario import Scenario
from lusee_bayes.visibilities import Visibilities

Overrides = Annotated[list[str], Parameter(name="--set", negative="")]
Quiet = Annotated[bool, Parameter(name=["--quiet", "-q"], negative="")]
# 10,25 or 5:50:5
Frequencies = Annotated[str | None, Parameter(name="--frequencies")]
Verbose = Annotated[bool, Parameter(name=["--verbose", "-v"], negative="")]
Output = Annotated[Path | None, Parameter(name=["--output", "-o"])]


def prepare(
    scenario: Scenario, data: Path | None, stages: Stages
) -> tuple[Experiment, Visibilities]:
    """The experiment of a scenario with the data of a file, or with its own simulated ones."""
    measured = None if data is None else read_data(data, scenario)
    experiment = Experiment.from_scenario(scenario, measured, stages)
    if measured is None:
        with stages("noise"):
            measured = experiment.simulate()
            measured.data.block_until_ready()
    return experiment, measured


def parse_frequencies(text: str) -> list[float]:
    """MHz out of ``10,25,30`` or of ``first:last:step``, the last included.

    InputError if it is neither.
    """
    try:
        if ":" not in text:
            found = [float(part) for part in text.split(",")]
        else:
            first, last, step = (float(part) for part in text.split(":"))
            count = round((last - first) / step)
            found = [first + k * step for k in range(count + 1)]
            if not step > 0 or not np.isclose(found[-1] if found else np.nan, last):
                raise ValueError
    except (ValueError, ZeroDivisionError, OverflowError):
        found = []
    if not found or any(b <= a for a, b in pairwise(found)):
        raise InputError(
            f"--frequencies {text}: expected growing MHz, as 10,25,30 or as 5:50:5 (first, last, "
            "step)"
        )
    return found
