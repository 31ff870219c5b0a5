"""lusee-bayes sample: draws from the posterior of a NumPyro program."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from cyclopts import Parameter
from rich.console import Console

from lusee_bayes import sample_diagnostic_plots, sample_plots
from lusee_bayes.checks import InputError
from lusee_bayes.commands.options import (
    Frequencies,
    Output,
    Overrides,
    Quiet,
    Verbose,
    parse_frequencies,
    prepare,
)
from lusee_bayes.inference import Sampler
from lusee_bayes.map_files import write_cube
from lusee_bayes.programs import load_program
from lusee_bayes.progress import Stages
from lusee_bayes.report import REPORT, write_report
from lusee_bayes.sample_run import SampleRun, run_sampler
from lusee_bayes.scenario import Scenario, load_scenario
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
    frequencies: Frequencies = None,
    set_: Overrides | None = None,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Sample the posterior of a NumPyro program by Hamiltonian Monte Carlo.

    Draws are written as they come: a run that was stopped goes on with --resume.

    Example: lusee-bayes sample fiducial --set lmax=20 --draws 500 -o output/hmc

    Example: lusee-bayes sample gain_1e-2 --frequencies 10,25,40 --resume -o output/three

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
    frequencies
        Channels in MHz, as 10,25,30 or as first:last:step, one after the other: each in a folder of
        its own, and their maps together in cubes. With --resume, finished ones are taken over.
    set_
        key.path=value; overrides an entry of the scenario, as often as needed.
    quiet
        Print nothing but errors.
    verbose
        Tell the memory in use after every stage.
    """
    console = Console(quiet=quiet, soft_wrap=True)
    overrides = list(set_ or [])
    if frequencies is not None:
        overrides.append(f"frequencies_mhz={parse_frequencies(frequencies)}")
    resolved = load_scenario(scenario, overrides)
    if resolved.joint:
        raise InputError(
            "channels are sampled one by one; the joint posterior is Gaussian, and lusee-bayes map "
            "--joint --draws N draws from it exactly"
        )
    program = load_program(model or ("systematics" if resolved.samples else "sky"))
    sampler = Sampler(
        chains=chains, warmup=warmup, draws=draws, seed=resolved.seed, algorithm=algorithm
    )
    folder = output or Path("output") / f"{Path(scenario).stem}-{program.name}"

    def sampled(one: Scenario, where: Path) -> SampleRun:
        stages = Stages(console, verbose=verbose)
        experiment, measured = prepare(one, data, stages)
        run = run_sampler(
            experiment, measured, program, sampler, where, resume=resume, stages=stages
        )
        for path in write_run(run, where, stages):
            console.print(f"  {path}", highlight=False)
        console.print(headline(run), highlight=False)
        return run

    if not resolved.frequencies_mhz:
        sampled(resolved, folder)
        console.print(f"look at {folder / REPORT}", highlight=False)
        return
    means, stds = [], []
    for channel in resolved.channels():
        console.print(f"{channel.frequency_mhz:g} MHz", highlight=False)
        maps = sampled(channel, folder / f"{channel.frequency_mhz:g}MHz").maps
        means.append(maps["mean"])
        stds.append(maps["std"])
    with staged(folder) as stage:
        write_cube(stage / "mean.fits", "mean", np.stack(means), resolved)
        write_cube(stage / "std.fits", "std", np.stack(stds), resolved)
        (stage / "scenario.yaml").write_text(resolved.to_yaml())
    console.print(f"look at the {REPORT} of every channel in {folder}", highlight=False)


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
