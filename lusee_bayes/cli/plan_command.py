"""lusee-bayes plan: which observation is worth more, before there are data."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import yaml
from cyclopts import Parameter
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from lusee_bayes.cli.options import Overrides, Quiet, Verbose, say
from lusee_bayes.core.checks import InputError
from lusee_bayes.core.progress import Stages
from lusee_bayes.experiment.scenario import load_scenario
from lusee_bayes.results.forecast import AS_GIVEN, Forecast, Variation, baseline, forecast_rows
from lusee_bayes.results.variations import default_variations
from lusee_bayes.runs.plan_run import run_plan


def plan_command(
    scenario: str,
    *others: str,
    output: Annotated[Path, Parameter(name=["--output", "-o"])] = Path("output/plan"),
    vary: Annotated[list[str] | None, Parameter(negative="")] = None,
    set_: Overrides | None = None,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Say what observations would tell: information, modes with SNR > 1, ell_cross; without data.

    Example: lusee-bayes plan fiducial gain_1e-2 -o output/plan

    Example: lusee-bayes plan fiducial --vary frequency_mhz=10,25,40

    Parameters
    ----------
    scenario
        A YAML file, or the name of a scenario of the package (fiducial, ...).
    others
        More scenarios; each is planned with all variations.
    output
        Folder for the table and the figure.
    vary
        key.path=value,value,...; an entry of the scenario and the values to try, as often as
        needed, instead of turntable, duration, nights, duty cycle and lost antennas.
    set_
        key.path=value; overrides an entry of every scenario, as often as needed.
    quiet
        Print nothing but errors.
    verbose
        Tell the memory in use after every stage.
    """
    console = Console(quiet=quiet, soft_wrap=True)
    sources = [scenario, *others]
    if len(set(sources)) < len(sources):
        twice = next(s for s in sources if sources.count(s) > 1)
        raise InputError(f"the scenario '{twice}' is given twice; give each once")
    variations = [
        variation
        for source in sources
        for variation in (
            own_variations(source, vary, set_ or [])
            if vary
            else possible(default_variations(source, load_scenario(source, set_ or [])), console)
        )
    ]
    run = run_plan(variations, output, stages=Stages(console, verbose=verbose))
    for source in sources:
        console.print(as_text([f for f in run.forecasts if f.variation.source == source]))
    say(console, *(f"  {path}" for path in run.files))
    say(console, *(headline(run.forecasts, source) for source in sources))
    say(console, f"look at {run.folder}/figures/plan.png")


def own_variations(source: str, vary: list[str], overrides: list[str]) -> list[Variation]:
    """The scenario as baseline, and with every value of every ``key.path=value,value,...``.

    InputError if one of them is not of that form, or its values are not the scenario's.
    """
    found = [Variation(source, AS_GIVEN, AS_GIVEN, load_scenario(source, overrides))]
    for text in vary:
        key, _, listed = text.partition("=")
        try:
            values = yaml.safe_load(f"[{listed}]")
        except yaml.YAMLError:
            values = []
        if not key or not values:
            raise InputError(
                f"--vary takes key.path=value,value,... (as "
                f"noise.radiometer.duty_cycle=0.25,0.5), got '{text}'"
            )
        for value in values:
            change = f"{key}={json.dumps(value, default=str)}"
            found.append(
                Variation(source, key, f"{value}", load_scenario(source, [*overrides, change]))
            )
    return found


def possible(variations: list[Variation], console: Console) -> list[Variation]:
    """The scenario as given and the variations that can be observed; the others are named."""
    kept = variations[:1]
    for variation in variations[1:]:
        obstacle = variation.obstacle()
        if obstacle is None:
            kept.append(variation)
        else:
            what = f"{variation.source}, {variation.family}, {variation.name}"
            console.print(f"  left out: {what}: {obstacle}", highlight=False, markup=False)
    return kept


def as_text(forecasts: list[Forecast]) -> Table:
    """The forecasts of one scenario as a table for the terminal."""
    source = forecasts[0].variation.source
    text = Table(title=escape(source), title_justify="left", title_style="bold")
    text.add_column("variation", no_wrap=True)
    for name in ("days", "data", "bits", "more", "SNR > 1", "ell_cross", "deg"):
        text.add_column(name, justify="right")
    family = ""
    for row, forecast in zip(forecast_rows(forecasts), forecasts, strict=True):
        if row["family"] != family:
            family = str(row["family"])
            text.add_section()
            if family != AS_GIVEN:
                text.add_row(f"[italic]{escape(family)}")
        text.add_row(
            escape(str(row["variation"])),
            f"{forecast.days:.1f}",
            str(row["n_data"]),
            f"{forecast.information_bits:.0f}",
            f"{float(str(row['difference_bits'])):+.0f}",
            str(row["modes_snr_above_1"]),
            str(row["ell_cross"]),
            str(row["resolution_deg"]),
        )
    return text


def headline(forecasts: list[Forecast], source: str) -> str:
    """What the scenario itself tells, and which of its variations tells most."""
    first = baseline(forecasts, source)
    best = max(
        (f for f in forecasts if f.variation.source == source), key=lambda f: f.information_bits
    )
    text = f"{source}: {first.information_bits:.0f} bits, {first.modes} modes with SNR > 1"
    if best.information_bits > first.information_bits:
        more = best.information_bits - first.information_bits
        text += f"; most with {best.variation.family}, {best.variation.name}: +{more:.0f} bits"
    return text
