"""lusee-bayes compare-priors: one data set under several priors."""

from __future__ import annotations

from pathlib import Path

from rich.console import Console

from lusee_bayes.cli.options import (
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
from lusee_bayes.core.progress import Stages


def compare_priors_command(
    scenario: str,
    *,
    data: Path | None = None,
    truth: Flag = False,
    priors: str | None = None,
    draws: Number = 100,
    output: Output = None,
    set_: Overrides | None = None,
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
        Visibilities to map; without them the scenario's own are simulated.
    truth
        The given data are of the scenario's own sky: count how often error bars hold it.
    priors
        Two or more, with commas: isotropic, isotropic-sky (C_ell of the scenario's sky; simulated
        data only), modulated, lognormal, local_scales. By default all that can be. The scenario's
        own section counts for the prior of its kind.
    draws
        Draws of learned parameters, to check Laplace's evidence by importance sampling; 0 for none.
    output
        Folder for the results; by default output/NAME-priors.
    set_
        key.path=value; overrides an entry of the scenario, as often as needed.
    force
        Replace results of another run in the folder.
    quiet
        Print nothing but errors.
    verbose
        Print the memory in use after every stage.
    """
    from lusee_bayes.cli.tables import priors_table
    from lusee_bayes.report.pages import REPORT
    from lusee_bayes.runs.compare_priors_run import run_compare_priors

    console = Console(quiet=quiet, soft_wrap=True)
    run = run_compare_priors(
        load(scenario, set_),
        output or default_folder(scenario, "-priors"),
        None if priors is None else [name.strip() for name in priors.split(",") if name.strip()],
        data=data,
        truth=truth,
        draws=draws,
        name=Path(scenario).stem,
        replace=force,
        stages=Stages(console, verbose=verbose),
    )
    say(console, *(f"  {path}" for path in run.files))
    show(console, priors_table(run.result))
    say(console, *run.result.lines(), f"look at {run.folder / REPORT}")
