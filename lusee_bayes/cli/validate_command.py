"""lusee-bayes validate: Hamiltonian Monte Carlo and simulations against the analytic posterior."""

from __future__ import annotations

from pathlib import Path

from rich.console import Console

from lusee_bayes.cli.options import (
    Clock,
    Cluster,
    Count,
    DataFiles,
    Flag,
    Force,
    Number,
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


def validate_command(
    scenario: str,
    *,
    data: DataFiles = None,
    clock: Clock = None,
    output: Output = None,
    resume: Flag = False,
    chains: Count = 4,
    draws: Count = 1000,
    warmup: Number = 150,
    simulations: Count = 500,
    set_: Overrides | None = None,
    workers: Workers = None,
    cluster: Cluster = None,
    force: Force = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> int:
    """Check the posterior of a scenario by HMC and by simulated data sets.

    Ends with exit code 1 if a check fails; the thresholds are in validation.md.

    Parameters
    ----------
    scenario
        A YAML file, or the name of a scenario of the package (fiducial, ...).
    data
        Visibilities to use: a file, or sessions of the spectrometer, one or many; without them the
        scenario's own are simulated.
    output
        Folder for the results; by default output/NAME-validation.
    resume
        Go on with the unfinished run in the folder, or judge the finished one again.
    chains
        Chains side by side.
    draws
        Draws of each chain, after warmup.
    warmup
        Iterations in which the step size is found; they are not kept.
    simulations
        Data sets for simulation-based calibration.
    set_
        key.path=value; overrides an entry of the scenario, as often as needed.
    workers
        Processes of this machine that share out the simulated data sets; by default one.
    cluster
        Address of a Dask scheduler, as tcp://host:8786, whose workers share them out; by default
        DASK_SCHEDULER_ADDRESS.
    """
    from lusee_bayes.sampling.least import require_draws, require_simulations

    require_simulations(simulations)
    require_draws(draws)
    from lusee_bayes.core.engine import open_engine

    console = Console(quiet=quiet, soft_wrap=True)
    resolved, stages = (
        load(scenario, set_, replaces=output if force else None, flight__clock=clock),
        Stages(console, verbose=verbose),
    )
    from lusee_bayes.cli.tables import checks_table
    from lusee_bayes.report.pages import REPORT
    from lusee_bayes.results.cost import demand_of_calibration
    from lusee_bayes.runs.validate_run import run_validate
    from lusee_bayes.sampling.hmc import Sampler

    demand = demand_of_calibration(resolved)
    with open_engine(demand, workers, cluster) as engine:
        run = run_validate(
            resolved,
            output or default_folder(scenario, "-validation"),
            name=Path(scenario).stem,
            sampler=Sampler(chains=chains, warmup=warmup, draws=draws, seed=resolved.seed),
            simulations=simulations,
            data=data,
            resume=resume,
            engine=engine,
            replace=force,
            stages=stages,
        )
    say(console, *(f"  {path}" for path in run.files))
    show(console, checks_table(run.result.checks))
    say(console, f"{run.result.headline()}; look at {run.folder / REPORT}")
    return 0 if run.result.passed else 1
