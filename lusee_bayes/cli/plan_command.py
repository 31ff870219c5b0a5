"""The command ``plan``: what it forecasts, and what it says of it."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter
from rich.console import Console

from lusee_bayes.cli.options import EngineOptions, Output, ScenarioOptions, say
from lusee_bayes.core.errors import InputError
from lusee_bayes.core.reading import parse_yaml
from lusee_bayes.experiment.scenario import load_scenario
from lusee_bayes.results.forecast import AS_GIVEN, Forecast, Variation, baseline
from lusee_bayes.runs.forecasting import default_variations


def plan_command(
    scenario: str,
    *others: str,
    output: Output = Path("output/plan"),
    vary: Annotated[tuple[str, ...], Parameter(negative="", show_default=False)] = (),
    options: ScenarioOptions = ScenarioOptions(),
    engine: EngineOptions = EngineOptions(),
) -> None:
    """Forecast information, modes with SNR > 1 and ell_cross of observations, without data.

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
    """
    from lusee_bayes.cli.tables import forecast_table
    from lusee_bayes.runs.cost import demand_of, posterior_cost
    from lusee_bayes.runs.plan_run import run_plan

    sources = [scenario, *others]
    if len(set(sources)) < len(sources):
        twice = next(s for s in sources if sources.count(s) > 1)
        raise InputError(f"the scenario '{twice}' is given twice; give each once")
    variations: list[Variation] = []
    for source in sources:
        if vary:
            variations += own_variations(source, vary, options.set_)
        else:
            given = default_variations(source, load_scenario(source, options.set_))
            variations += possible(given, options.console)
    demand = demand_of([posterior_cost(v.scenario) for v in variations])
    with engine.open(demand) as opened:
        run = run_plan(variations, output, engine=opened, **options.running())
    for source in sources:
        table = forecast_table([f for f in run.result if f.variation.source == source])
        options.tell((), table=table)
    options.tell(run.files)
    for source in sources:
        options.say(headline(run.result, source))
        if offsets := baseline(run.result, source).offsets_line():
            options.say(f"{source}: {offsets}")
    options.say(f"look at {run.folder}/figures/plan.png")


def own_variations(source: str, vary: Sequence[str], overrides: Sequence[str]) -> list[Variation]:
    """The scenario as baseline, and with every value of every ``key.path=value,value,...``.

    InputError if one of them is not of that form, or its values are not the scenario's.
    """
    found = [Variation(source, AS_GIVEN, AS_GIVEN, load_scenario(source, overrides))]
    for text in vary:
        key, _, listed = text.partition("=")
        values = parse_yaml(f"[{listed}]", f"--vary {text}")
        if not key or not isinstance(values, list) or not values:
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
            say(console, f"  left out: {what}: {obstacle}")
    return kept


def headline(forecasts: list[Forecast], source: str) -> str:
    """The information in the scenario as given, and its most informative variation."""
    first = baseline(forecasts, source)
    best = max(
        (f for f in forecasts if f.variation.source == source), key=lambda f: f.information_bits
    )
    text = f"{source}: {first.information_bits:.0f} bits, {first.modes} modes with expected SNR > 1"
    if best.information_bits > first.information_bits:
        more = best.information_bits - first.information_bits
        text += f"; most: {best.variation.family}, {best.variation.name}: +{more:.0f} bits"
    return text
