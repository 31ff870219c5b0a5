"""lusee-bayes sample: draws from the posterior of a NumPyro program."""

from __future__ import annotations

from typing import Literal

from rich.console import Console

from lusee_bayes.cli.options import (
    Clock,
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
    default_folder,
    load,
    say,
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
