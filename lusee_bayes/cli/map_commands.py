"""Commands that make data and maps.

lusee-bayes map: a posterior map of a scenario, or of given data.

lusee-bayes simulate: visibilities of a scenario.

lusee-bayes reduce: sessions of the spectrometer to bands and bins of time.

lusee-bayes average: means of data over longer times.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter
from rich.console import Console

from lusee_bayes.cli.options import (
    Clock,
    Cluster,
    DataFiles,
    Flag,
    Force,
    ForceFile,
    Frequencies,
    Number,
    Output,
    Overrides,
    Quiet,
    Verbose,
    Workers,
    default_folder,
    load,
    parse_duration,
    parse_frequencies,
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
    from lusee_bayes.core.engines import open_engine
    from lusee_bayes.report.pages import REPORT
    from lusee_bayes.runs.cost import demand_of_channels
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


def simulate_command(
    scenario: str,
    *,
    output: Output = None,
    frequencies: Frequencies = None,
    flight: Flag = False,
    force: ForceFile = False,
    set_: Overrides | None = None,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Simulate the visibilities of a scenario.

    Parameters
    ----------
    scenario
        A YAML file, or the name of a scenario of the package (fiducial, ...).
    output
        The file to write, by default data.nc: netCDF, or luseepy's waterfall if the name ends in
        .fits. With --flight the folder to write into, by default flight.
    frequencies
        Channels of a waterfall in MHz, as 10,25,30 or as first:last:step; the noise of each has a
        seed of its own, one more than that of the channel before.
    flight
        Write sessions of the spectrometer, as they come from the lander (flight.simulated).
    set_
        key.path=value; overrides an entry of the scenario, as often as needed.
    """
    console = Console(quiet=quiet, soft_wrap=True)
    loaded, stages = (
        load(scenario, set_, replaces=output if force else None),
        Stages(console, verbose=verbose),
    )
    channels = () if frequencies is None else parse_frequencies(frequencies)
    if flight:
        from lusee_bayes.runs.data_run import run_simulate_flight

        folder = output or Path("flight")
        files = run_simulate_flight(
            loaded, folder, frequencies_mhz=channels, replace=force, stages=stages
        )
        spectra = f"{files.n_spectra} spectra of {len(files.sessions)} sessions -> {folder}"
        say(console, spectra, files.command)
        return
    from lusee_bayes.runs.data_run import run_simulate

    output = output or Path("data.nc")
    data = run_simulate(loaded, output, frequencies_mhz=channels, replace=force, stages=stages)
    say(
        console,
        f"{sum(d.layout.size for d in data)} visibilities of {data[0].layout.n_products} products "
        f"at {', '.join(f'{d.frequency_mhz:g}' for d in data)} MHz -> {output}",
    )


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
    from lusee_bayes.runs.data_run import reduced_lines, run_reduce

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
    from lusee_bayes.runs.data_run import run_average

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
