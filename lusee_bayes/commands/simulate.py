"""lusee-bayes simulate: visibilities of a scenario."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import numpy as np
from cyclopts import Parameter
from rich.console import Console

from lusee_bayes.building import build_impedance
from lusee_bayes.checks import InputError
from lusee_bayes.commands.options import Frequencies, Overrides, Quiet, Verbose, parse_frequencies
from lusee_bayes.experiment import Experiment
from lusee_bayes.progress import Stages
from lusee_bayes.scenario import load_scenario
from lusee_bayes.waterfalls import write_waterfall


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

    Example: lusee-bayes simulate fiducial --set seed=2 -o data.nc

    Example: lusee-bayes simulate fiducial --frequencies 10:30:5 -o waterfall.fits

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
        Tell the memory in use after every stage.
    """
    console = Console(quiet=quiet, soft_wrap=True)
    resolved = load_scenario(scenario, set_ or [])
    channels = [resolved]
    if frequencies is not None:
        if output.suffix != ".fits":
            raise InputError(
                f"'{output}': netCDF files hold one frequency; with --frequencies, give -o a name "
                "that ends in .fits"
            )
        channels = [
            load_scenario(scenario, [*(set_ or []), f"frequency_mhz={f}", f"seed={seed}"])
            for seed, f in enumerate(parse_frequencies(frequencies), resolved.seed)
        ]
    data = []
    for channel in channels:
        stages = Stages(console, verbose=verbose)
        if frequencies is not None:
            console.print(f"{channel.frequency_mhz:g} MHz", highlight=False)
        experiment = Experiment.from_scenario(channel, stages=stages)
        with stages("noise"):
            data.append(experiment.simulate())
    if output.suffix == ".fits":
        impedance = np.array([build_impedance(channel) for channel in channels])
        write_waterfall(output, data, impedance, resolved.to_yaml())
    else:
        data[0].write(output, {"scenario": resolved.to_yaml()})
    console.print(
        f"{sum(d.layout.size for d in data)} visibilities of {data[0].layout.n_products} products "
        f"at {', '.join(f'{d.frequency_mhz:g}' for d in data)} MHz -> {output}",
        highlight=False,
    )
