"""lusee-bayes reduce: sessions of the spectrometer to bands and bins of time."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter
from rich.console import Console

from lusee_bayes.cli.options import (
    Clock,
    ForceFile,
    Frequencies,
    Overrides,
    Quiet,
    Verbose,
    load,
    say,
)
from lusee_bayes.core.progress import Stages


def reduce_command(
    scenario: str,
    files: Annotated[list[Path], Parameter(required=True)],
    /,
    *,
    output: Annotated[Path, Parameter(name=["--output", "-o"])] = Path("reduced.nc"),
    frequencies: Frequencies = None,
    clock: Clock = None,
    set_: Overrides | None = None,
    force: ForceFile = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Calibrate, flag and average sessions of the spectrometer.

    Parameters
    ----------
    scenario
        A YAML file, or the name of a scenario of the package, with a section flight.
    files
        Sessions that luseepy has written, HDF5 or FITS, in any order.
    output
        The netCDF file to write, for map --data.
    frequencies
        Middles of the bands in MHz, as 10,25,30 or as first:last:step.
    set_
        key.path=value; overrides an entry of the scenario, as often as needed.
    """
    from lusee_bayes.core.checks import counted
    from lusee_bayes.runs.reduce_run import reduced_lines, run_reduce

    console = Console(quiet=quiet, soft_wrap=True)
    reduced = run_reduce(
        load(scenario, set_, frequencies, replaces=output if force else None, flight__clock=clock),
        files,
        output,
        replace=force,
        stages=Stages(console, verbose=verbose),
    )
    bands = counted(len(reduced.frequencies_mhz), "band")
    say(console, *reduced_lines(reduced), f"{bands} -> {output}")
