"""What ``lusee-bayes plan`` plans, and what it says of it."""

from __future__ import annotations

import json

from rich.console import Console

from lusee_bayes.core.errors import InputError
from lusee_bayes.core.reading import parse_yaml
from lusee_bayes.experiment.scenario import load_scenario
from lusee_bayes.results.forecast import AS_GIVEN, Forecast, Variation, baseline
from lusee_bayes.results.variations import default_variations


def variations_of(
    source: str, vary: list[str] | None, overrides: list[str], console: Console
) -> list[Variation]:
    """The variations of a scenario: those asked for, or else the default ones that are possible.

    InputError as :func:`own_variations`.
    """
    if vary:
        return own_variations(source, vary, overrides)
    return possible(default_variations(source, load_scenario(source, overrides)), console)


def own_variations(source: str, vary: list[str], overrides: list[str]) -> list[Variation]:
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
            console.print(f"  left out: {what}: {obstacle}", highlight=False, markup=False)
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
