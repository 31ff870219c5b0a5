"""lusee-bayes validate: Hamiltonian Monte Carlo and simulations against the analytic posterior."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from lusee_bayes import calibration, sample_plots
from lusee_bayes.calibration import LEVELS, Ranks, calibrate_sky
from lusee_bayes.commands.options import Output, Overrides, Quiet, Verbose, prepare
from lusee_bayes.commands.sample import Resume
from lusee_bayes.inference import Sampler
from lusee_bayes.programs import load_program
from lusee_bayes.progress import Stages
from lusee_bayes.report import REPORT, write_report
from lusee_bayes.sample_run import run_sampler
from lusee_bayes.scenario import load_scenario
from lusee_bayes.staging import staged
from lusee_bayes.validation import Check, Comparison, compare, require_draws


def validate_command(
    scenario: str,
    *,
    data: Path | None = None,
    output: Output = None,
    resume: Resume = False,
    chains: int = 4,
    draws: int = 1000,
    warmup: int = 150,
    simulations: int = 500,
    set_: Overrides | None = None,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> int:
    """Check the analytic posterior of a scenario by HMC and by simulated data sets.

    Ends with exit code 1 if a check fails; the thresholds are in validation.md.

    Example: lusee-bayes validate gain_1e-2 --set lmax=8 -o output/check

    Parameters
    ----------
    scenario
        A YAML file, or the name of a scenario of the package (fiducial, ...).
    data
        Visibilities to use; without them the scenario's own are simulated.
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
    quiet
        Print nothing but errors.
    verbose
        Tell the memory in use after every stage.
    """
    console = Console(quiet=quiet, soft_wrap=True)
    program = load_program("sky")
    calibration.require_simulations(simulations)
    require_draws(draws)
    resolved = load_scenario(scenario, set_ or [])
    sampler = Sampler(chains=chains, warmup=warmup, draws=draws, seed=resolved.seed)
    folder = output or Path("output") / f"{Path(scenario).stem}-validation"
    stages = Stages(console, verbose=verbose)
    experiment, measured = prepare(resolved, data, stages)
    run = run_sampler(experiment, measured, program, sampler, folder, resume=resume, stages=stages)
    with stages("files"):
        written = run.write(folder)
    with stages("comparison"):
        stats = run.tree["sample_stats"]
        found = compare(run.skies, run.posterior, stats["diverging"].values, stats["energy"].values)
    with stages.progress("calibration", simulations) as update:
        ranks = calibrate_sky(
            run.model, run.model, n_simulations=simulations, seed=resolved.seed, report=update
        )
    checks = [*found.checks, calibration_check(ranks)]
    with stages("figures"), staged(folder) as stage:
        (stage / "figures").mkdir()
        sample_plots.comparison(found).savefig(stage / "figures" / "comparison.png", dpi=110)
        sample_plots.calibration(ranks).savefig(stage / "figures" / "calibration.png", dpi=110)
        (stage / "validation.json").write_text(json.dumps(as_json(found, ranks), indent=2) + "\n")
        (stage / "validation.md").write_text(as_text(scenario, checks, ranks))
    written.append(write_report(folder))
    names = [
        "validation.md",
        "validation.json",
        "figures/comparison.png",
        "figures/calibration.png",
    ]
    for path in [*written, *(folder / name for name in names)]:
        console.print(f"  {path}", highlight=False)
    console.print(as_table(checks))
    passed = all(check.passed for check in checks)
    console.print(
        f"{'passed' if passed else 'FAILED'}: {sum(c.passed for c in checks)} of {len(checks)} "
        f"checks; look at {folder / REPORT}",
        highlight=False,
    )
    return 0 if passed else 1


def calibration_check(ranks: Ranks) -> Check:
    """The verdict of calibration as one check."""
    return Check(
        "calibration",
        float(ranks.p_values().min()),
        ranks.threshold,
        1.0,
        f"smallest p-value of {len(ranks.names)} rank histograms over {ranks.n_simulations} "
        "simulations",
    )


def as_table(checks: list[Check]) -> Table:
    """The checks for the terminal."""
    table = Table("check", "value", "allowed", "", "what it is")
    for check in checks:
        verdict = "ok" if check.passed else "FAILED"
        table.add_row(check.name, f"{check.value:.4g}", allowed(check), verdict, check.meaning)
    return table


def allowed(check: Check) -> str:
    """The interval of a check in words."""
    if check.lower == check.upper:
        return f"{check.upper:g}"
    if not np.isfinite(check.upper):
        return f"at least {check.lower:.4g}"
    if check.lower == -check.upper:
        return f"+- {check.upper:.4g}"
    return f"{check.lower:.4g} to {check.upper:.4g}"


def as_text(scenario: str, checks: list[Check], ranks: Ranks) -> str:
    """validation.md: the checks, how their thresholds come about, and coverage."""
    lines = [
        f"# Validation of {Path(scenario).stem}",
        "",
        "| check | value | allowed | | what it is |",
        "| --- | --- | --- | --- | --- |",
    ]
    for check in checks:
        verdict = "ok" if check.passed else "**failed**"
        lines.append(
            f"| {check.name} | {check.value:.4g} | {allowed(check)} | {verdict} | {check.meaning} |"
        )
    lines += [
        "",
        "Means, variances and calibration: a true posterior fails each of them once in a thousand "
        "runs. Eigenvalues: against simulated exact chains that move as far from draw to draw. "
        "R-hat: 1.01, or what the largest of so many modes reaches by chance. Effective sizes, "
        "BFMI: as is common.",
        "",
        f"Coverage over {ranks.n_simulations} simulations (regions: distance from the mean; else "
        "central intervals):",
        "",
        "| quantity | " + " | ".join(f"{p:.0%}" for p in LEVELS) + " |",
        "| --- |" + " --- |" * len(LEVELS),
    ]
    for name, coverage in ranks.coverage().items():
        lines.append(f"| {name} | " + " | ".join(f"{coverage[p]:.1%}" for p in LEVELS) + " |")
    errors = " | ".join(f"{ranks.coverage_error(p):.1%}" for p in LEVELS)
    lines.append(f"| standard error | {errors} |")
    return "\n".join(lines) + "\n"


def as_json(found: Comparison, ranks: Ranks) -> dict[str, object]:
    """validation.json: every check, mode by mode where there are modes."""
    checks = [*found.checks, calibration_check(ranks)]
    return {
        "passed": all(check.passed for check in checks),
        "checks": [
            {
                "name": check.name,
                "value": check.value,
                "lower": check.lower if np.isfinite(check.lower) else None,
                "upper": check.upper if np.isfinite(check.upper) else None,
                "passed": check.passed,
                "meaning": check.meaning,
            }
            for check in checks
        ],
        "mean_z": found.mean_z.tolist(),
        "variance_ratio": found.variance_ratio.tolist(),
        "variance_error": found.variance_error.tolist(),
        "eigenvalues": found.eigenvalues.tolist(),
        "null_eigenvalues": found.null_eigenvalues.tolist(),
        "ess_bulk": found.ess_bulk.tolist(),
        "ess_tail": found.ess_tail.tolist(),
        "coverage": {
            name: {f"{p:g}": share for p, share in levels.items()}
            for name, levels in ranks.coverage().items()
        },
        "p_values": dict(zip(ranks.names, ranks.p_values().tolist(), strict=True)),
    }
