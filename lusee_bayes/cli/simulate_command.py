"""lusee-bayes simulate: visibilities of a scenario."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter
from rich.console import Console

from lusee_bayes.cli.options import (
    Frequencies,
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
    output: Annotated[Path, Parameter(name=["--output", "-o"])] = Path("data.nc"),
    frequencies: Frequencies = None,
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
        The file to write: netCDF, or luseepy's waterfall if the name ends in .fits.
    frequencies
        Channels of a waterfall in MHz, as 10,25,30 or as first:last:step; the noise of each has a
        seed of its own, one more than that of the channel before.
    set_
        key.path=value; overrides an entry of the scenario, as often as needed.
    quiet
        Print nothing but errors.
    verbose
        Print the memory in use after every stage.
    """
    from lusee_bayes.runs.simulate_run import run_simulate

    console = Console(quiet=quiet, soft_wrap=True)
    data = run_simulate(
        load(scenario, set_),
        output,
        frequencies_mhz=() if frequencies is None else parse_frequencies(frequencies),
        stages=Stages(console, verbose=verbose),
    )
    say(
        console,
        f"{sum(d.layout.size for d in data)} visibilities of {data[0].layout.n_products} products "
        f"at {', '.join(f'{d.frequency_mhz:g}' for d in data)} MHz -> {output}",
    )
