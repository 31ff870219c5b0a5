"""lusee-bayes map: a posterior map of a scenario, or of given data."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import xarray as xr
from cyclopts import Parameter
from rich.console import Console

from lusee_bayes import diagnostic_plots, plots
from lusee_bayes.checks import InputError
from lusee_bayes.commands.map_channels import map_channels
from lusee_bayes.commands.options import (
    Frequencies,
    Output,
    Overrides,
    Quiet,
    Verbose,
    parse_frequencies,
    prepare,
)
from lusee_bayes.devices import use_cpu_devices
from lusee_bayes.diagnostics import diagnostics, write_diagnostics
from lusee_bayes.joining import is_launched
from lusee_bayes.processes import run_processes
from lusee_bayes.progress import Stages
from lusee_bayes.report import REPORT, write_report
from lusee_bayes.results import MapResult
from lusee_bayes.scenario import load_scenario
from lusee_bayes.staging import staged
from lusee_bayes.updatable import read_updatable


def map_command(
    scenario: str,
    *,
    data: Path | None = None,
    truth: Annotated[bool, Parameter(negative="")] = False,
    output: Output = None,
    draws: int = 0,
    covariance: Annotated[bool, Parameter(negative="")] = False,
    compact: Annotated[bool, Parameter(negative="")] = False,
    updatable: Annotated[bool, Parameter(negative="")] = False,
    onto: Path | None = None,
    frequencies: Frequencies = None,
    joint: Annotated[bool, Parameter(negative="")] = False,
    processes: int = 1,
    devices: int | None = None,
    set_: Overrides | None = None,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> int | None:
    """Make a posterior map of a scenario, or of given data.

    Example: lusee-bayes map fiducial --set frequency_mhz=10 -o output/ten

    Example: lusee-bayes map fiducial --data waterfall.fits --set beam.file=beam.fits

    Example: lusee-bayes map fiducial --frequencies 5:50:1 --joint --draws 20 -o output/cube

    Example: lusee-bayes map fiducial --data second_cycle.nc --onto output/first_cycle

    Parameters
    ----------
    scenario
        A YAML file, or the name of a scenario of the package (fiducial, ...).
    data
        Visibilities to map, of a file of simulate or a waterfall of luseepy; without them the
        scenario's own are simulated.
    truth
        The given data are of the scenario's own sky: compare the map with it.
    output
        Folder for the results; by default output/NAME.
    draws
        How many posterior draws to keep in posterior.nc.
    covariance
        Keep the posterior covariance in posterior.nc.
    compact
        Write posterior_compact.npz, of which NumPy alone can make draws.
    updatable
        Keep in posterior.nc what --onto needs.
    onto
        Folder of an updatable run: the data are added to what its data have told.
    frequencies
        Channels in MHz, as 10,25,30 or as first:last:step: a map of each, by itself. A run that was
        stopped goes on with the same command.
    joint
        One posterior for the skies of all channels, with the scenario's spectral prior.
    processes
        Share the channels among so many processes on this machine. Under Slurm, srun says how many.
    devices
        Make so many devices of the CPU, and share the channels among them.
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
    if joint:
        overrides.append("joint=true")
    resolved = load_scenario(scenario, overrides)
    if resolved.samples:
        raise InputError(
            "the scenario says that something is to be sampled, and a map can only marginalise; "
            f"use: lusee-bayes sample {scenario}"
        )
    folder = output or Path("output") / Path(scenario).stem
    if resolved.frequencies_mhz:
        for name, given in (
            ("--covariance", covariance),
            ("--compact", compact),
            ("--updatable", updatable),
            ("--onto", onto is not None),
        ):
            if given:
                raise InputError(f"{name} is for a single frequency; leave out frequencies_mhz")
        if processes != 1 and not is_launched():
            return run_processes(processes, sys.argv[1:])
        if devices is not None:
            use_cpu_devices(devices)
        map_channels(
            resolved,
            folder,
            data=data,
            truth=truth,
            draws=draws,
            console=console,
            verbose=verbose,
        )
        return None
    if processes != 1 or devices is not None:
        raise InputError("--processes and --devices share out channels; give --frequencies")
    stages = Stages(console, verbose=verbose)
    earlier = None if onto is None else read_updatable(onto, resolved)
    experiment, measured = prepare(resolved, data, stages)
    if truth:
        measured = replace(measured, truth=experiment.sky.modes)
    if experiment.base(measured).too_large:
        raise InputError(
            f"{measured.layout.size} data are too many to judge each by all others, which needs "
            f"the whole of A; use --frequencies {resolved.frequency_mhz:g} for a map without that"
        )
    result = MapResult.from_experiment(experiment, measured, stages, earlier, root=updatable)
    with stages("diagnostics"):
        found = diagnostics(result)
    figures = write_figures(result, found, folder, stages)
    with stages("files"):
        files = result.write(folder, draws, covariance, compact, updatable)
        with staged(folder) as stage:
            write_diagnostics(found, stage / "diagnostics.nc")
        files += [folder / "diagnostics.nc", write_report(folder)]
    for path in files + figures:
        console.print(f"  {path}", highlight=False)
    console.print(headline(result), highlight=False)
    for line in flux_lines(result):
        console.print(line, highlight=False)
    console.print(found.attrs["verdict"], highlight=False)
    console.print(f"look at {folder / REPORT}", highlight=False)
    return None


def write_figures(result: MapResult, found: xr.Dataset, folder: Path, stages: Stages) -> list[Path]:
    """Draw every figure of a map run into folder/figures."""
    drawn = {
        "maps": lambda: plots.maps(result),
        "data_vector": lambda: plots.data_vector(result.data),
        "beams": lambda: plots.beams(result.experiment.scenario),
        "fidelity": lambda: plots.fidelity(result),
        "spectra": lambda: plots.spectra(result),
        "draws": lambda: diagnostic_plots.draws(found),
        "residuals": lambda: diagnostic_plots.residuals(found),
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


def flux_lines(result: MapResult) -> list[str]:
    """One line for every source, or block of it."""
    if result.fluxes is None:
        return []
    lines = []
    for row in result.fluxes.to_dict("records"):
        name = row["source"] if row["block"] == 0 else f"{row['source']} ({row['block']})"
        text = f"{name}: {row['flux_jy']:.4g} +- {row['std_jy']:.2g} Jy"
        if not row["above_horizon"]:
            text += ", the prior's: it is never above the horizon"
        lines.append(text)
    return lines
