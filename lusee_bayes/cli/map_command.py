"""lusee-bayes map: a posterior map of a scenario, or of given data."""

from __future__ import annotations

import sys
from pathlib import Path

from rich.console import Console

from lusee_bayes.cli.options import (
    Count,
    Flag,
    Force,
    Frequencies,
    Number,
    Output,
    Overrides,
    Quiet,
    Verbose,
    default_folder,
    load,
    say,
)
from lusee_bayes.core.errors import InputError
from lusee_bayes.core.progress import Stages


def map_command(
    scenario: str,
    *,
    data: Path | None = None,
    truth: Flag = False,
    output: Output = None,
    draws: Number | None = None,
    covariance: Flag = False,
    compact: Flag = False,
    updatable: Flag = False,
    onto: Path | None = None,
    frequencies: Frequencies = None,
    joint: Flag = False,
    processes: Count = 1,
    devices: Count | None = None,
    set_: Overrides | None = None,
    force: Force = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> int | None:
    """Make a posterior map of a scenario, or of given data.

    Parameters
    ----------
    scenario
        A YAML file, or the name of a scenario of the package (fiducial, ...).
    data
        Visibilities to map, of a file of simulate or a waterfall of luseepy; without them the
        scenario's own are simulated.
    truth
        The given data are of the scenario's own sky: compare the map with it.
    output
        Folder for the results; by default output/NAME.
    draws
        Number of posterior draws to keep in posterior.nc (output.draws).
    covariance
        Keep the posterior covariance in posterior.nc (output.covariance).
    compact
        Write posterior_compact.npz, from which NumPy alone makes draws (output.compact).
    updatable
        Keep in posterior.nc what --onto needs (output.updatable).
    onto
        Folder of an updatable run: the data are added to those behind it.
    frequencies
        Channels in MHz, as 10,25,30 or as first:last:step: a map of each, on its own. The same
        command continues an interrupted run.
    joint
        One posterior for the skies of all channels, with the scenario's spectral prior.
    processes
        Number of processes on this machine that share the channels. Under Slurm, srun sets it.
    devices
        Number of devices to make of the CPU, which share the channels.
    set_
        key.path=value; overrides an entry of the scenario, as often as needed.
    force
        Replace results of another run in the folder.
    quiet
        Print nothing but errors.
    verbose
        Print the memory in use after every stage.
    """
    from lusee_bayes.core.launcher import run_processes
    from lusee_bayes.core.process_group import use_cpu_devices
    from lusee_bayes.core.rendezvous import is_launched, join
    from lusee_bayes.report.pages import REPORT
    from lusee_bayes.runs.map_run import run_map

    console = Console(quiet=quiet, soft_wrap=True)
    resolved = load(
        scenario,
        set_,
        frequencies,
        joint=joint,
        output__draws=draws,
        output__covariance=covariance,
        output__compact=compact,
        output__updatable=updatable,
    )
    if not resolved.frequencies_mhz and (processes != 1 or devices is not None):
        raise InputError("--processes and --devices share out channels; give --frequencies")
    if processes != 1 and not is_launched():
        return run_processes(processes, sys.argv[1:])
    if devices is not None:
        use_cpu_devices(devices)
    folder = output or default_folder(scenario)
    with join() as group:
        stages = Stages(console if group.is_first else None, verbose=verbose)
        run = run_map(
            resolved,
            folder,
            data=data,
            truth=truth,
            onto=onto,
            group=group,
            replace=force,
            stages=stages,
        )
        if group.is_first:
            say(console, *(f"  {path}" for path in run.files), *run.result.lines())
            say(console, f"look at {run.folder / REPORT}")
    return None
