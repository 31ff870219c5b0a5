"""Commands that sample and validate.

lusee-bayes sample: draws from the posterior of a NumPyro program.

lusee-bayes validate: Hamiltonian Monte Carlo and simulations against the analytic posterior.
"""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from rich.console import Console

from lusee_bayes.cli.options import (
    Clock,
    Cluster,
    Count,
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
    show,
)
from lusee_bayes.core.progress import Stages


def sample_command(
    scenario: str,
    *,
    model: str | None = None,
    data: DataFiles = None,
    clock: Clock = None,
    output: Output = None,
    resume: Flag = False,
    chains: Count = 4,
    draws: Count = 1000,
    warmup: Number = 150,
    algorithm: Literal["nuts", "hmc"] = "nuts",
    frequencies: Frequencies = None,
    set_: Overrides | None = None,
    force: Force = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Sample the posterior of a NumPyro program by Hamiltonian Monte Carlo.

    Draws are written during the run: after an interruption, --resume continues it.

    Parameters
    ----------
    scenario
        A YAML file, or the name of a scenario of the package (fiducial, ...).
    model
        The program: a Python file with a function model, or one of the package by its name (sky,
        sky_marginal, gains, instrument, ...). By default systematics, where the scenario says that
        something is to be sampled, else sky.
    data
        Visibilities to use: a file, or sessions of the spectrometer, one or many; without them the
        scenario's own are simulated.
    output
        Folder for the results; by default output/NAME-MODEL.
    resume
        Continue the unfinished run in the folder.
    chains
        Chains side by side.
    draws
        Draws of each chain, after warmup.
    warmup
        Iterations in which the step size is found; they are not kept.
    algorithm
        The No-U-Turn Sampler, or Hamiltonian Monte Carlo with trajectories of fixed length.
    frequencies
        Channels in MHz, as 10,25,30 or as first:last:step, one after the other: each in a folder of
        its own, and their maps together in cubes. With --resume, finished ones are taken over.
    set_
        key.path=value; overrides an entry of the scenario, as often as needed.
    """
    from lusee_bayes.report.pages import REPORT
    from lusee_bayes.runs.sample_run import default_program, run_sample
    from lusee_bayes.sampling.hmc import Sampler
    from lusee_bayes.sampling.programs import load_program

    console = Console(quiet=quiet, soft_wrap=True)
    resolved = load(
        scenario, set_, frequencies, replaces=output if force else None, flight__clock=clock
    )
    program = default_program(resolved) if model is None else load_program(model)
    sampler = Sampler(
        chains=chains, warmup=warmup, draws=draws, seed=resolved.seed, algorithm=algorithm
    )
    run = run_sample(
        resolved,
        output or default_folder(scenario, f"-{program.name}"),
        program=program,
        sampler=sampler,
        data=data,
        resume=resume,
        replace=force,
        stages=Stages(console, verbose=verbose),
    )
    say(console, *(f"  {path}" for path in run.files))
    for result in run.result:
        if resolved.frequencies_mhz:
            say(console, f"{result.experiment.scenario.frequency_mhz:g} MHz")
        say(console, *result.lines())
    if resolved.frequencies_mhz:
        say(console, f"look at the {REPORT} of every channel in {run.folder}")
    else:
        say(console, f"look at {run.folder / REPORT}")


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
    from lusee_bayes.sampling.hmc import require_draws, require_simulations

    require_simulations(simulations)
    require_draws(draws)
    from lusee_bayes.core.engines import open_engine

    console = Console(quiet=quiet, soft_wrap=True)
    resolved, stages = (
        load(scenario, set_, replaces=output if force else None, flight__clock=clock),
        Stages(console, verbose=verbose),
    )
    from lusee_bayes.cli.tables import checks_table
    from lusee_bayes.report.pages import REPORT
    from lusee_bayes.runs.cost import demand_of_calibration
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
