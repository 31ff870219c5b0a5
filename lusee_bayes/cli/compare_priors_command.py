"""lusee-bayes compare-priors: one data set under several priors."""

from __future__ import annotations

from pathlib import Path

from rich.console import Console

from lusee_bayes.cli.options import (
    Clock,
    Cluster,
    DataFiles,
    Flag,
    Force,
    Output,
    Overrides,
    Quiet,
    Verbose,
    Workers,
    default_folder,
    load,
    say,
    show,
)
from lusee_bayes.core.progress import Stages


def compare_priors_command(
    scenario: str,
    *,
    data: DataFiles = None,
    clock: Clock = None,
    truth: Flag = False,
    priors: str | None = None,
    output: Output = None,
    set_: Overrides | None = None,
    workers: Workers = None,
    cluster: Cluster = None,
    force: Force = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Map one data set under several priors, and say which of them it prefers.

    Parameters
    ----------
    scenario
        A YAML file, or the name of a scenario of the package (fiducial, ...).
    data
        Visibilities to map: a file, or sessions of the spectrometer, one or many; without them the
        scenario's own are simulated.
    truth
        The given data are of the scenario's own sky: count how often error bars hold it.
    priors
        Two or more, with commas: isotropic, isotropic-sky (C_ell of the scenario's sky; simulated
        data only), local_scales. By default all that can be. The scenario's
        own section counts for the prior of its kind.
    output
        Folder for the results; by default output/NAME-priors.
    set_
        key.path=value; overrides an entry of the scenario, as often as needed.
    workers
        Processes of this machine that share out the priors; by default as many
        as pay.
    cluster
        Address of a Dask scheduler, as tcp://host:8786, whose workers share out the priors;
        by default DASK_SCHEDULER_ADDRESS.
    """
    from lusee_bayes.cli.tables import priors_table
    from lusee_bayes.core.engine import open_engine
    from lusee_bayes.report.pages import REPORT
    from lusee_bayes.results.cost import demand_of, posterior_cost
    from lusee_bayes.runs.compare_priors_run import run_compare_priors

    console = Console(quiet=quiet, soft_wrap=True)
    resolved, stages = (
        load(scenario, set_, replaces=output if force else None, flight__clock=clock),
        Stages(console, verbose=verbose),
    )
    names = None if priors is None else [n.strip() for n in priors.split(",") if n.strip()]
    demand = demand_of([posterior_cost(resolved)])
    with open_engine(demand, workers, cluster) as engine:
        run = run_compare_priors(
            resolved,
            output or default_folder(scenario, "-priors"),
            names,
            data=data,
            truth=truth,
            name=Path(scenario).stem,
            engine=engine,
            replace=force,
            stages=stages,
        )
    say(console, *(f"  {path}" for path in run.files))
    show(console, priors_table(run.result))
    say(console, *run.result.lines(), f"look at {run.folder / REPORT}")
