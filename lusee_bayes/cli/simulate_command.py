"""lusee-bayes simulate: visibilities of a scenario."""

from __future__ import annotations

from pathlib import Path

from rich.console import Console

from lusee_bayes.cli.options import (
    Flag,
    ForceFile,
    Frequencies,
    Output,
    Overrides,
    Quiet,
    Verbose,
    load,
    parse_frequencies,
    say,
)
from lusee_bayes.core.progress import Stages


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
        from lusee_bayes.runs.flight_run import run_simulate_flight

        folder = output or Path("flight")
        files = run_simulate_flight(
            loaded, folder, frequencies_mhz=channels, replace=force, stages=stages
        )
        spectra = f"{files.n_spectra} spectra of {len(files.sessions)} sessions -> {folder}"
        say(console, spectra, files.command)
        return
    from lusee_bayes.runs.simulate_run import run_simulate

    output = output or Path("data.nc")
    data = run_simulate(loaded, output, frequencies_mhz=channels, replace=force, stages=stages)
    say(
        console,
        f"{sum(d.layout.size for d in data)} visibilities of {data[0].layout.n_products} products "
        f"at {', '.join(f'{d.frequency_mhz:g}' for d in data)} MHz -> {output}",
    )
