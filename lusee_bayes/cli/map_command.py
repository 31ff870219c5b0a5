"""lusee-bayes map: a posterior map of a scenario, or of given data."""

from __future__ import annotations

from pathlib import Path

from rich.console import Console

from lusee_bayes.cli.options import (
    Clock,
    Cluster,
    DataFiles,
    Flag,
    Force,
    Frequencies,
    Number,
    Output,
    Overrides,
    Quiet,
    Verbose,
    Workers,
    default_folder,
    load,
    say,
)
from lusee_bayes.core.errors import InputError
from lusee_bayes.core.progress import Stages


def map_command(
    scenario: str,
    *,
    data: DataFiles = None,
    clock: Clock = None,
    truth: Flag = False,
    output: Output = None,
    draws: Number | None = None,
    covariance: Flag = False,
    updatable: Flag = False,
    onto: Path | None = None,
    diagnose: Flag = False,
    frequencies: Frequencies = None,
    joint: Flag = False,
    workers: Workers = None,
    cluster: Cluster = None,
    set_: Overrides | None = None,
    force: Force = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Make a posterior map of a scenario, or of given data.

    Parameters
    ----------
    scenario
        A YAML file, or the name of a scenario of the package (fiducial, ...).
    data
        Visibilities to map, of a file of simulate or reduce, a waterfall of luseepy, or sessions of
        its lusee.ingest, one or many; without them the scenario's own are simulated.
    truth
        The given data are of the scenario's own sky: compare the map with it.
    output
        Folder for the results; by default output/NAME.
    draws
        Number of posterior draws to keep in posterior.nc (output.draws).
    covariance
        Keep the posterior covariance in posterior.nc (output.covariance).
    updatable
        Keep in posterior.nc what --onto needs (output.updatable).
    onto
        Folder of an updatable run: the data are added to those behind it.
    diagnose
        Try the usual mistakes (signs, exchanged ports, angles, clocks, ...) even if the data fit;
        where they do not, they are tried anyway.
    frequencies
        Channels in MHz, as 10,25,30 or as first:last:step: a map of each, on its own. The same
        command continues an interrupted run.
    joint
        One posterior for the skies of all channels, with the scenario's spectral prior.
    workers
        Processes of this machine that share out the channels; by default one.
    cluster
        Address of a Dask scheduler, as tcp://host:8786, whose workers share out the channels; by
        default DASK_SCHEDULER_ADDRESS.
    set_
        key.path=value; overrides an entry of the scenario, as often as needed.
    """
    from lusee_bayes.core.engine import open_engine
    from lusee_bayes.report.pages import REPORT
    from lusee_bayes.results.cost import demand_of_channels
    from lusee_bayes.runs.map_run import run_map

    console = Console(quiet=quiet, soft_wrap=True)
    resolved = load(
        scenario,
        set_,
        frequencies,
        replaces=output if force else None,
        joint=joint,
        flight__clock=clock,
        output__draws=draws,
        output__covariance=covariance,
        output__updatable=updatable,
    )
    folder = output or default_folder(scenario)
    stages = Stages(console, verbose=verbose)
    given = {"data": data, "truth": truth, "onto": onto, "replace": force, "stages": stages}
    given["diagnosed"] = diagnose
    if resolved.frequencies_mhz:
        demand = demand_of_channels(resolved)
        with open_engine(demand, workers, cluster) as engine:
            run = run_map(resolved, folder, engine=engine, **given)
    elif workers is None and cluster is None:
        run = run_map(resolved, folder, **given)
    else:
        raise InputError("--workers and --cluster share out channels; give --frequencies")
    say(console, *(f"  {path}" for path in run.files), *run.result.lines())
    say(console, f"look at {run.folder / REPORT}")
