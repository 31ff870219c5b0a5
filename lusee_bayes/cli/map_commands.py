"""Commands that make data and maps: ``map``, ``simulate``, ``reduce`` and ``average``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from lusee_bayes.cli.options import (
    DataOptions,
    EngineOptions,
    Flag,
    Number,
    Output,
    ScenarioOptions,
    parse_duration,
    parse_frequencies,
)
from lusee_bayes.core.errors import InputError


def map_command(
    scenario: str,
    *,
    truth: Flag = False,
    draws: Number | None = None,
    covariance: Flag = False,
    information: Flag = False,
    add: Path | None = None,
    diagnose: Flag = False,
    frequencies: str | None = None,
    joint: Flag = False,
    options: DataOptions = DataOptions(),
    engine: EngineOptions = EngineOptions(),
) -> None:
    """Make a posterior map of a scenario, or of given data.

    Parameters
    ----------
    scenario
        A YAML file, or the name of a scenario of the package (fiducial, ...).
    truth
        The given data are of the scenario's own sky: compare the map with it.
    draws
        Number of posterior draws to keep in posterior.nc (output.draws).
    covariance
        Keep the posterior covariance in posterior.nc (output.covariance).
    information
        Keep in posterior.nc what the data say of the sky, for --add (output.information).
    add
        Folder of a run with --information: the data are added to those behind it.
    diagnose
        Judge every group of data, and try the usual mistakes (signs, exchanged ports, angles,
        clocks, ...), even if the data fit; where they do not, both is done anyway.
    frequencies
        Channels in MHz, as 10,25,30 or as first:last:step: a map of each, on its own. The same
        command continues an interrupted run.
    joint
        One posterior for the skies of all channels, with the scenario's spectral prior.
    """
    from lusee_bayes.report.pages import REPORT
    from lusee_bayes.runs.cost import demand_of_channels
    from lusee_bayes.runs.map_run import run_map

    resolved = options.loaded(
        scenario,
        frequencies,
        joint=joint,
        output__draws=draws,
        output__covariance=covariance,
        output__information=information,
    )
    given = {"data": options.data, "truth": truth, "earlier": add, "thorough": diagnose}
    given |= options.running()
    folder = options.folder(scenario)
    if resolved.frequencies_mhz:
        with engine.open(demand_of_channels(resolved)) as opened:
            run = run_map(resolved, folder, engine=opened, **given)
    elif engine == EngineOptions():
        run = run_map(resolved, folder, **given)
    else:
        raise InputError("--workers and --cluster share out channels; give --frequencies")
    options.tell(run.files, *run.result.lines(), f"look at {run.folder / REPORT}")


def simulate_command(
    scenario: str,
    *,
    output: Output | None = None,
    frequencies: str | None = None,
    flight: Flag = False,
    options: ScenarioOptions = ScenarioOptions(),
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
    """
    loaded = options.load(scenario, replaces=output)
    channels = () if frequencies is None else parse_frequencies(frequencies)
    given = {"frequencies_mhz": channels} | options.running()
    from lusee_bayes.runs.data_run import run_simulate, run_simulate_flight

    if flight:
        folder = output or Path("flight")
        files = run_simulate_flight(loaded, folder, **given)
        spectra = f"{files.n_spectra} spectra of {len(files.sessions)} sessions -> {folder}"
        options.say(spectra, files.command)
        return
    output = output or Path("data.nc")
    data = run_simulate(loaded, output, **given)
    options.say(
        f"{sum(d.layout.size for d in data)} visibilities of {data[0].layout.n_products} products "
        f"at {', '.join(f'{d.frequency_mhz:g}' for d in data)} MHz -> {output}",
    )


def reduce_command(
    scenario: str,
    files: Annotated[list[Path], Parameter(required=True)],
    /,
    *,
    output: Output = Path("reduced.nc"),
    frequencies: str | None = None,
    clock: str | None = None,
    options: ScenarioOptions = ScenarioOptions(),
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
    clock
        Clock reference in JSON, for sessions with no absolute time, or to correct the UTC that they
        state (flight.clock).
    """
    from lusee_bayes.core.checks import counted
    from lusee_bayes.runs.data_run import reduced_lines, run_reduce

    loaded = options.load(scenario, frequencies, output, flight__clock=clock)
    reduced = run_reduce(loaded, files, output, **options.running())
    bands = counted(len(reduced.frequencies_mhz), "band")
    options.say(*reduced_lines(reduced), f"{bands} -> {output}")


def average_command(
    data: Path,
    *,
    to: str,
    output: Output = Path("averaged.nc"),
    scenario: str = "fiducial",
    no_information: Flag = False,
    options: ScenarioOptions = ScenarioOptions(),
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
    no_information
        Leave out the information, which takes the memory and the time of two maps.
    """
    from lusee_bayes.runs.data_run import run_average

    run = run_average(
        options.load(scenario, replaces=output),
        data,
        parse_duration(to),
        output,
        information=not no_information,
        **options.running(),
    )
    options.say(*run.lines(), f"{run.averaged.layout.size} visibilities -> {output}")
