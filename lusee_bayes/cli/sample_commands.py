"""Commands that sample: ``sample`` draws from a posterior, ``validate`` checks the analytic one."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from lusee_bayes.cli.options import Count, DataOptions, EngineOptions, Flag, Number


def sample_command(
    scenario: str,
    *,
    model: str | None = None,
    resume: Flag = False,
    chains: Count = 4,
    draws: Count = 1000,
    warmup: Number = 150,
    algorithm: Literal["nuts", "hmc"] = "nuts",
    frequencies: str | None = None,
    options: DataOptions = DataOptions(),
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
    """
    from lusee_bayes.report.pages import REPORT
    from lusee_bayes.runs.sample_run import default_program, run_sample
    from lusee_bayes.sampling.hmc import Sampler
    from lusee_bayes.sampling.programs import load_program

    resolved = options.loaded(scenario, frequencies)
    program = default_program(resolved) if model is None else load_program(model)
    run = run_sample(
        resolved,
        options.folder(scenario, f"-{program.name}"),
        program=program,
        sampler=Sampler(
            chains=chains, warmup=warmup, draws=draws, seed=resolved.seed, algorithm=algorithm
        ),
        data=options.data,
        resume=resume,
        **options.running(),
    )
    options.tell(run.files)
    for result in run.result:
        if resolved.frequencies_mhz:
            options.say(f"{result.experiment.scenario.frequency_mhz:g} MHz")
        options.say(*result.lines())
    if resolved.frequencies_mhz:
        options.say(f"look at the {REPORT} of every channel in {run.folder}")
    else:
        options.say(f"look at {run.folder / REPORT}")


def validate_command(
    scenario: str,
    *,
    resume: Flag = False,
    chains: Count = 4,
    draws: Count = 1000,
    warmup: Number = 150,
    simulations: Count = 500,
    options: DataOptions = DataOptions(),
    engine: EngineOptions = EngineOptions(),
) -> int:
    """Check the posterior of a scenario by HMC and by simulated data sets.

    Ends with exit code 1 if a check fails; the thresholds are in validation.md.

    Parameters
    ----------
    scenario
        A YAML file, or the name of a scenario of the package (fiducial, ...).
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
    """
    from lusee_bayes.sampling.least import require_draws, require_simulations

    require_simulations(simulations)
    require_draws(draws)
    resolved = options.loaded(scenario)
    from lusee_bayes.cli.tables import checks_table
    from lusee_bayes.report.pages import REPORT
    from lusee_bayes.runs.validate_run import demand_of_calibration, run_validate
    from lusee_bayes.sampling.hmc import Sampler

    with engine.open(demand_of_calibration(resolved)) as opened:
        run = run_validate(
            resolved,
            options.folder(scenario, "-validation"),
            name=Path(scenario).stem,
            sampler=Sampler(chains=chains, warmup=warmup, draws=draws, seed=resolved.seed),
            simulations=simulations,
            data=options.data,
            resume=resume,
            engine=opened,
            **options.running(),
        )
    verdict = f"{run.result.headline()}; look at {run.folder / REPORT}"
    options.tell(run.files, verdict, table=checks_table(run.result.checks))
    return 0 if run.result.passed else 1
