"""lusee-bayes map of several frequencies: a cube of maps, on any number of processes."""

from __future__ import annotations

from pathlib import Path

from rich.console import Console

from lusee_bayes import cube_plots
from lusee_bayes.channel_run import ChannelRun
from lusee_bayes.cube import Cube
from lusee_bayes.joining import join
from lusee_bayes.progress import Stages
from lusee_bayes.report import REPORT, write_report
from lusee_bayes.scenario import Scenario
from lusee_bayes.staging import require_folder, staged


def map_channels(
    scenario: Scenario,
    folder: Path,
    *,
    data: Path | None,
    truth: bool,
    draws: int,
    console: Console,
    verbose: bool,
) -> None:
    """Work out and write a run of several frequencies; every process of a run comes here."""
    require_folder(folder)
    with join() as fleet:
        stages = Stages(console if fleet.is_first else None, verbose=verbose)
        run = ChannelRun.make(
            scenario, folder, data=data, truth=truth, n_draws=draws, fleet=fleet, stages=stages
        )
        if not fleet.is_first:
            return
        cube = Cube.of(run)
        figures = write_figures(cube, folder, stages)
        with stages("files"):
            files = [*cube.write(folder), write_report(folder)]
        run.files.forget()
        for path in files + figures:
            console.print(f"  {path}", highlight=False)
        console.print(headline(cube), highlight=False)
        console.print(cube.verdict(), highlight=False)
        console.print(f"look at {folder / REPORT}", highlight=False)


def write_figures(cube: Cube, folder: Path, stages: Stages) -> list[Path]:
    """Draw every figure of the run into folder/figures."""
    drawn = {
        "maps": cube_plots.maps,
        "spectra": cube_plots.spectra,
        "fidelity": cube_plots.fidelity,
        "chi2": cube_plots.chi2,
    }
    with stages("figures"), staged(folder) as stage:
        (stage / "figures").mkdir()
        for name, draw in drawn.items():
            draw(cube).savefig(stage / "figures" / f"{name}.png", dpi=100)
    return [folder / "figures" / f"{name}.png" for name in drawn]


def headline(cube: Cube) -> str:
    """The few figures that matter, in one line."""
    summary = cube.summary()
    kind = "one posterior" if summary["joint"] else "each by itself"
    parts = [f"{len(cube.frequencies_mhz)} frequencies, {kind}"]
    crosses = [c["ell_cross"] for c in summary["channels"] if c["ell_cross"] is not None]
    if crosses:
        parts.append(f"SNR < 1 first at ell {min(crosses)} to {max(crosses)}")
    if summary["log_evidence"] is not None:
        parts.append(f"ln evidence {summary['log_evidence']:.1f}")
    if summary["joint"] and summary["joint"]["iterations"]:
        parts.append(
            f"{summary['joint']['iterations']} iterations, "
            f"{summary['joint']['refinement_sigma']:.1g} sigma left"
        )
    return ", ".join(parts)
