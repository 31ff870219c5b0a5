"""lusee-bayes plan: a forecast of the information in observations, before there are data."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter
from rich.console import Console

from lusee_bayes.cli.options import (
    Cluster,
    Force,
    Overrides,
    Quiet,
    Verbose,
    Workers,
    say,
    show,
)
from lusee_bayes.core.errors import InputError
from lusee_bayes.core.progress import Stages


def plan_command(
    scenario: str,
    *others: str,
    output: Annotated[Path, Parameter(name=["--output", "-o"])] = Path("output/plan"),
    vary: Annotated[list[str] | None, Parameter(negative="")] = None,
    set_: Overrides | None = None,
    workers: Workers = None,
    cluster: Cluster = None,
    force: Force = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Forecast information, modes with SNR > 1 and ell_cross of observations, without data.

    Parameters
    ----------
    scenario
        A YAML file, or the name of a scenario of the package (fiducial, ...).
    others
        More scenarios; each is planned with all variations.
    output
        Folder for the table and the figure.
    vary
        key.path=value,value,...; an entry of the scenario and the values to try, as often as
        needed, instead of turntable, duration, nights, duty cycle and lost antennas.
    set_
        key.path=value; overrides an entry of every scenario, as often as needed.
    workers
        Processes of this machine that share out the variations; by default one.
    cluster
        Address of a Dask scheduler, as tcp://host:8786, whose workers share out the variations; by
        default DASK_SCHEDULER_ADDRESS.
    """
    from lusee_bayes.cli.plan_variations import headline, variations_of
    from lusee_bayes.cli.tables import forecast_table
    from lusee_bayes.core.engine import open_engine
    from lusee_bayes.results.cost import demand_of, posterior_cost
    from lusee_bayes.results.forecast import baseline
    from lusee_bayes.runs.plan_run import run_plan

    console = Console(quiet=quiet, soft_wrap=True)
    sources = [scenario, *others]
    if len(set(sources)) < len(sources):
        twice = next(s for s in sources if sources.count(s) > 1)
        raise InputError(f"the scenario '{twice}' is given twice; give each once")
    variations = [v for s in sources for v in variations_of(s, vary, set_ or [], console)]
    stages = Stages(console, verbose=verbose)
    demand = demand_of([posterior_cost(v.scenario) for v in variations])
    with open_engine(demand, workers, cluster) as engine:
        run = run_plan(variations, output, engine=engine, replace=force, stages=stages)
    for source in sources:
        show(console, forecast_table([f for f in run.result if f.variation.source == source]))
    say(console, *(f"  {path}" for path in run.files))
    for source in sources:
        say(console, headline(run.result, source))
        if offsets := baseline(run.result, source).offsets_line():
            say(console, f"{source}: {offsets}")
    say(console, f"look at {run.folder}/figures/plan.png")
