"""What each command does: scenario in, files and a few figures out."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import jax
from cyclopts import Parameter
from rich.console import Console

from lusee_bayes import plots
from lusee_bayes.experiment import Experiment
from lusee_bayes.inspection import describe
from lusee_bayes.paper import run_paper
from lusee_bayes.progress import Stages
from lusee_bayes.results import MapResult, staged
from lusee_bayes.scenario import load_scenario
from lusee_bayes.visibilities import read_visibilities

Overrides = Annotated[list[str], Parameter(name="--set", negative="")]
Quiet = Annotated[bool, Parameter(name=["--quiet", "-q"], negative="")]


def simulate_command(
    scenario: str,
    *,
    output: Annotated[Path, Parameter(name=["--output", "-o"])] = Path("data.nc"),
    set_: Overrides | None = None,
    quiet: Quiet = False,
) -> None:
    """Simulate the visibilities of a scenario.

    Example: lusee-bayes simulate fiducial --set seed=2 -o data.nc

    Parameters
    ----------
    scenario
        A YAML file, or the name of a scenario of the package (fiducial, ...).
    output
        The netCDF file to write.
    set_
        key.path=value; overrides an entry of the scenario, as often as needed.
    quiet
        Print nothing but errors.
    """
    console = Console(quiet=quiet, soft_wrap=True)
    resolved = load_scenario(scenario, set_ or [])
    stages = Stages(console)
    experiment = Experiment.from_scenario(resolved, stages=stages)
    with stages("noise"):
        data = experiment.simulate()
    data.write(output, {"scenario": resolved.to_yaml()})
    console.print(
        f"{data.layout.size} visibilities of {data.layout.n_products} products at "
        f"{data.frequency_mhz:g} MHz -> {output}",
        highlight=False,
    )


def map_command(
    scenario: str,
    *,
    data: Path | None = None,
    output: Annotated[Path | None, Parameter(name=["--output", "-o"])] = None,
    draws: int = 0,
    covariance: Annotated[bool, Parameter(negative="")] = False,
    set_: Overrides | None = None,
    quiet: Quiet = False,
) -> None:
    """Make a posterior map of a scenario, or of given data.

    Example: lusee-bayes map fiducial --set frequency_mhz=10 -o output/ten

    Parameters
    ----------
    scenario
        A YAML file, or the name of a scenario of the package (fiducial, ...).
    data
        Visibilities to map; without them the scenario's own are simulated.
    output
        Folder for the results; by default output/NAME.
    draws
        How many posterior draws to keep in posterior.nc.
    covariance
        Keep the posterior covariance in posterior.nc.
    set_
        key.path=value; overrides an entry of the scenario, as often as needed.
    quiet
        Print nothing but errors.
    """
    console = Console(quiet=quiet, soft_wrap=True)
    resolved = load_scenario(scenario, set_ or [])
    folder = output or Path("output") / Path(scenario).stem
    stages = Stages(console)
    measured = None if data is None else read_visibilities(data)
    experiment = Experiment.from_scenario(resolved, measured, stages)
    if measured is None:
        with stages("noise"):
            measured = jax.block_until_ready(experiment.simulate())
    result = MapResult.from_experiment(experiment, measured, stages)
    figures = write_figures(result, folder, stages)
    with stages("files"):
        files = result.write(folder, draws, covariance)
    for path in files + figures:
        console.print(f"  {path}", highlight=False)
    console.print(headline(result), highlight=False)
    console.print(f"look at {folder}/figures/maps.png", highlight=False)


def write_figures(result: MapResult, folder: Path, stages: Stages) -> list[Path]:
    """Draw every figure of a map run into folder/figures."""
    drawn = {
        "maps": lambda: plots.maps(result),
        "data_vector": lambda: plots.data_vector(result.data),
        "beams": lambda: plots.beams(result.experiment.scenario),
        "fidelity": lambda: plots.fidelity(result),
        "spectra": lambda: plots.spectra(result),
    }
    with stages("figures"), staged(folder) as stage:
        (stage / "figures").mkdir()
        for name, draw in drawn.items():
            draw().savefig(stage / "figures" / f"{name}.png", dpi=110)
    return [folder / "figures" / f"{name}.png" for name in drawn]


def headline(result: MapResult) -> str:
    """The few figures that matter, in one line."""
    summary = result.summary()
    parts = []
    if result.truth is not None:
        cross = summary["ell_cross"]
        parts.append("SNR > 1 at every ell" if cross is None else f"SNR < 1 first at ell {cross}")
    resolution = summary["effective_resolution_deg"]
    if resolution is not None:
        parts.append(f"resolution {resolution:.1f} deg")
    parts.append(f"chi2 {summary['chi2']:.0f} (expected {summary['chi2_expected']:.0f})")
    parts.append(f"ln evidence {summary['log_evidence']:.1f}")
    parts.append(f"{summary['information_bits']:.0f} bits")
    return ", ".join(parts)


def paper_command(
    *,
    output: Annotated[Path, Parameter(name=["--output", "-o"])] = Path("output/paper"),
    sky: Annotated[list[Path] | None, Parameter(consume_multiple=True, negative="")] = None,
    quiet: Quiet = False,
) -> None:
    """Reproduce the figures of the reference paper and judge its claims.

    Cases that were computed before with the same scenario and version are kept, so that an
    interrupted run goes on where it stopped.

    Example: lusee-bayes paper -o output/paper --sky exp1.0MHz_sky.hdf5 exp10.0MHz_sky.hdf5

    Parameters
    ----------
    output
        Folder for the cases, figures and tables.
    sky
        ULSA HDF5 files whose names tell the frequency, as exp10.0MHz_sky.hdf5; each case scales
        the one nearest in log frequency.
        Without them the embedded sky is used.
    quiet
        Print nothing but errors.
    """
    console = Console(quiet=quiet, soft_wrap=True)
    written = run_paper(output, skies=sky or [], console=console)
    for path in written:
        if path.suffix != ".nc":
            console.print(f"  {path}", highlight=False)
    console.print((output / "claims.md").read_text().splitlines()[0], highlight=False)
    console.print(f"look at {output}/claims.md", highlight=False)


def info_command(file: Path) -> None:
    """Say what is in a file: visibilities, a posterior, or a sky map.

    Example: lusee-bayes info output/fiducial/posterior.nc
    """
    Console(soft_wrap=True).print(describe(file), highlight=False, markup=False)
