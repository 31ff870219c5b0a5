"""lusee-bayes average: means of data over longer times."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter
from rich.console import Console

from lusee_bayes.cli.options import (
    Flag,
    ForceFile,
    Overrides,
    Quiet,
    Verbose,
    load,
    parse_duration,
    say,
)
from lusee_bayes.core.progress import Stages


def average_command(
    data: Path,
    *,
    to: str,
    output: Annotated[Path, Parameter(name=["--output", "-o"])] = Path("averaged.nc"),
    scenario: str = "fiducial",
    set_: Overrides | None = None,
    no_information: Flag = False,
    force: ForceFile = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Average data over longer times, and say what that costs.

    Parameters
    ----------
    data
        Visibilities whose samples have windows; of a waterfall the scenario's frequency is taken.
    to
        Length of the averages: 30s, 10min, 2h, 1d.
    output
        The netCDF file to write.
    scenario
        Instrument, noise and prior for the information that is lost: a YAML file, or the name of a
        scenario of the package.
    set_
        key.path=value; overrides an entry of the scenario, as often as needed.
    no_information
        Leave out the information, which takes the memory and the time of two maps.
    """
    from lusee_bayes.runs.average_run import run_average

    console = Console(quiet=quiet, soft_wrap=True)
    run = run_average(
        load(scenario, set_, replaces=output if force else None),
        data,
        parse_duration(to),
        output,
        information=not no_information,
        replace=force,
        stages=Stages(console, verbose=verbose),
    )
    say(console, *run.lines(), f"{run.averaged.layout.size} visibilities -> {output}")
