"""lusee-bayes validate: Hamiltonian Monte Carlo and simulations against the analytic posterior."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter
from rich.console import Console

from lusee_bayes.cli.options import (
    Count,
    Flag,
    Force,
    Number,
    Output,
    Overrides,
    Quiet,
    Verbose,
    default_folder,
    load,
    say,
    show,
)
from lusee_bayes.core.errors import InputError
from lusee_bayes.core.progress import Stages


def validate_command(
    scenario: str,
    *,
    skies: Annotated[list[str] | None, Parameter(consume_multiple=True, negative="")] = None,
    data: Path | None = None,
    output: Output = None,
    resume: Flag = False,
    chains: Count = 4,
    draws: Count = 1000,
    warmup: Number = 150,
    simulations: Count = 500,
    set_: Overrides | None = None,
    force: Force = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> int:
    """Check the posterior of a scenario by HMC and by simulated data sets, or on given skies.

    Ends with exit code 1 if a check fails; the thresholds are in validation.md or coverage.md.

    Parameters
    ----------
    scenario
        A YAML file, or the name of a scenario of the package (fiducial, ...).
    skies
        Skies to map with the scenario's prior and to compare with the error bars: files, or
        embedded, smooth and spotty with a seed, as in embedded:2. Nothing is sampled then.
    data
        Visibilities to use; without them the scenario's own are simulated.
    output
        Folder for the results; by default output/NAME-validation, or NAME-skies.
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
    force
        Replace results of another run in the folder.
    quiet
        Print nothing but errors.
    verbose
        Print the memory in use after every stage.
    """
    if skies is not None:
        return _on_skies(scenario, skies, data, output, resume, set_, force, quiet, verbose)
    from lusee_bayes.sampling.least import require_draws, require_simulations

    require_simulations(simulations)
    require_draws(draws)
    from lusee_bayes.cli.tables import checks_table
    from lusee_bayes.report.pages import REPORT
    from lusee_bayes.runs.validate_run import run_validate
    from lusee_bayes.sampling.hmc import Sampler

    console = Console(quiet=quiet, soft_wrap=True)
    resolved = load(scenario, set_)
    run = run_validate(
        resolved,
        output or default_folder(scenario, "-validation"),
        name=Path(scenario).stem,
        sampler=Sampler(chains=chains, warmup=warmup, draws=draws, seed=resolved.seed),
        simulations=simulations,
        data=data,
        resume=resume,
        replace=force,
        stages=Stages(console, verbose=verbose),
    )
    say(console, *(f"  {path}" for path in run.files))
    show(console, checks_table(run.result.checks))
    say(console, f"{run.result.headline()}; look at {run.folder / REPORT}")
    return 0 if run.result.passed else 1


def _on_skies(
    scenario: str,
    skies: list[str],
    data: Path | None,
    output: Path | None,
    resume: bool,
    set_: list[str] | None,
    force: bool,
    quiet: bool,
    verbose: bool,
) -> int:
    if data is not None or resume:
        raise InputError("--skies simulates its data, all at once; leave out --data and --resume")
    from lusee_bayes.cli.tables import coverage_table
    from lusee_bayes.report.pages import REPORT
    from lusee_bayes.runs.skies_run import run_skies

    console = Console(quiet=quiet, soft_wrap=True)
    run = run_skies(
        load(scenario, set_),
        output or default_folder(scenario, "-skies"),
        skies,
        name=Path(scenario).stem,
        replace=force,
        stages=Stages(console, verbose=verbose),
    )
    say(console, *(f"  {path}" for path in run.files))
    show(console, coverage_table(run.result))
    say(console, run.result.thresholds())
    say(console, f"{run.result.headline()}; look at {run.folder / REPORT}")
    return 0 if run.result.passed else 1
