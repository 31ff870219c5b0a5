"""lusee-bayes simulate: visibilities of a scenario."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter
from rich.console import Console

from lusee_bayes.commands.options import Overrides, Quiet
from lusee_bayes.experiment import Experiment
from lusee_bayes.progress import Stages
from lusee_bayes.scenario import load_scenario


def simulate_command(
    scenario: str,
    *,
    output: Annotated[Path, Parameter(name=["--output", "-o"])] = Path("data.nc"),
    set_: Overrides | None = None,
    quiet: Quiet = False,
) -> None:
    """Simulate the visibilities of a scenario.

    Example: lusee-bayes simulate fiducial --set seed=2 -o data.nc

    Parameters
    ----------
    scenario
        A YAML file, or the name of a scenario of the package (fiducial, ...).
    output
        The netCDF file to write.
    set_
        key.path=value; overrides an entry of the scenario, as often as needed.
    quiet
        Print nothing but errors.
    """
    console = Console(quiet=quiet, soft_wrap=True)
    resolved = load_scenario(scenario, set_ or [])
    stages = Stages(console)
    experiment = Experiment.from_scenario(resolved, stages=stages)
    with stages("noise"):
        data = experiment.simulate()
    data.write(output, {"scenario": resolved.to_yaml()})
    console.print(
        f"{data.layout.size} visibilities of {data.layout.n_products} products at "
        f"{data.frequency_mhz:g} MHz -> {output}",
        highlight=False,
    )
