"""lusee-bayes sample: draws from the posterior of a NumPyro program."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter
from rich.console import Console

from lusee_bayes import sample_diagnostic_plots, sample_plots
from lusee_bayes.commands.options import Output, Overrides, Quiet, Verbose, prepare
from lusee_bayes.inference import Sampler
from lusee_bayes.programs import load_program
from lusee_bayes.progress import Stages
from lusee_bayes.report import REPORT, write_report
from lusee_bayes.sample_run import SampleRun, run_sampler
from lusee_bayes.scenario import load_scenario
from lusee_bayes.staging import staged

Resume = Annotated[bool, Parameter(negative="")]


def sample_command(
    scenario: str,
    *,
    model: str | None = None,
    data: Path | None = None,
    output: Output = None,
    resume: Resume = False,
    chains: int = 4,
    draws: int = 1000,
    warmup: int = 150,
    algorithm: Literal["nuts", "hmc"] = "nuts",
    set_: Overrides | None = None,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Sample the posterior of a NumPyro program by Hamiltonian Monte Carlo.

    Draws are written as they come: a run that was stopped goes on with --resume.

    Example: lusee-bayes sample fiducial --set lmax=20 --draws 500 -o output/hmc

    Parameters
    ----------
    scenario
        A YAML file, or the name of a scenario of the package (fiducial, ...).
    model
        The program: a Python file with a function model, or one of the package by its name (sky,
        sky_marginal, gains, instrument, ...). By default systematics, where the scenario says that
        something is to be sampled, else sky.
    data
        Visibilities to use; without them the scenario's own are simulated.
    output
        Folder for the results; by default output/NAME-MODEL.
    resume
        Go on with the unfinished run in the folder.
    chains
        Chains side by side.
    draws
        Draws of each chain, after warmup.
    warmup
        Iterations in which the step size is found; they are not kept.
    algorithm
        The No-U-Turn Sampler, or Hamiltonian Monte Carlo with trajectories of fixed length.
    set_
        key.path=value; overrides an entry of the scenario, as often as needed.
    quiet
        Print nothing but errors.
    verbose
        Tell the memory in use after every stage.
    """
    console = Console(quiet=quiet, soft_wrap=True)
    resolved = load_scenario(scenario, set_ or [])
    program = load_program(model or ("systematics" if resolved.samples else "sky"))
    sampler = Sampler(
        chains=chains, warmup=warmup, draws=draws, seed=resolved.seed, algorithm=algorithm
    )
    folder = output or Path("output") / f"{Path(scenario).stem}-{program.name}"
    stages = Stages(console, verbose=verbose)
    experiment, measured = prepare(resolved, data, stages)
    run = run_sampler(experiment, measured, program, sampler, folder, resume=resume, stages=stages)
    for path in write_run(run, folder, stages):
        console.print(f"  {path}", highlight=False)
    console.print(headline(run), highlight=False)
    console.print(f"look at {folder / REPORT}", highlight=False)


def write_run(run: SampleRun, folder: Path, stages: Stages) -> list[Path]:
    """Draw the figures and write every file of a sampled run."""
    drawn = {
        "uncertainty": lambda: sample_plots.uncertainty(run),
        "traces": lambda: sample_plots.traces(run),
        "ranks": lambda: sample_diagnostic_plots.ranks(run.quantities()),
        "energy": lambda: sample_diagnostic_plots.energy(run.tree["sample_stats"].dataset),
        "pairs": lambda: sample_diagnostic_plots.pairs(run.quantities()),
        "against_analytic": lambda: sample_diagnostic_plots.against_analytic(run.tree),
    }
    with stages("figures"), staged(folder) as stage:
        (stage / "figures").mkdir()
        for name, draw in drawn.items():
            draw().savefig(stage / "figures" / f"{name}.png", dpi=110)
    with stages("files"):
        files = run.write(folder)
        files.append(write_report(folder))
    return files + [folder / "figures" / f"{name}.png" for name in drawn]


def headline(run: SampleRun) -> str:
    """The few figures that matter, in one line."""
    table, figures = run.summary_table(), run.figures()
    parts = [
        f"{figures['chains']} x {figures['draws']} draws of {figures['program']}",
        f"R-hat at most {table['r_hat'].max():.4f}",
        f"bulk ESS at least {table['ess_bulk'].min():.0f}",
        f"{figures['divergences']} divergences",
    ]
    if run.gradients_per_second is not None:
        parts.append(f"{run.gradients_per_second:.0f} gradients/s")
    return ", ".join(parts)
