"""The variations of a scenario that a plan looks at by itself.

Turned in the same time and repeated at the same angles, so that a turn is compared with standing
still for as long.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from lusee_bayes.experiment.scenario import Scenario
from lusee_bayes.experiment.schema import RunSection
from lusee_bayes.results.forecast import AS_GIVEN, Variation

# one turn of the table
TURN_DEG = 30.0
# each run in so many parts, or all of them repeated so often
PARTS = (1, 2, 3)
CYCLES = (0.25, 0.5, 1.0, 2.0, 3.0)
DUTY_CYCLES = (0.25, 0.5, 1.0)


def default_variations(source: str, scenario: Scenario) -> list[Variation]:
    """The scenario as it is, then turntable, duration, nights, duty cycle and lost antennas.

    A schedule keeps its dates and angles.
    """
    families = {AS_GIVEN: {AS_GIVEN: scenario}}
    if scenario.observation.schedule is None:
        families |= families_of_runs(scenario)
    families["duty cycle"] = {f"{duty:g}": with_duty_cycle(scenario, duty) for duty in DUTY_CYCLES}
    found = [
        Variation(source, family, name, varied)
        for family, members in families.items()
        for name, varied in members.items()
    ]
    n_ports = scenario.beam.n_ports
    if n_ports > 1:
        found += [
            Variation(source, "antenna lost", f"port {port}", scenario, (port,))
            for port in range(n_ports)
        ]
    return found


def families_of_runs(scenario: Scenario) -> dict[str, dict[str, Scenario]]:
    """The scenario with its runs turned, longer or shorter, or by night."""
    runs = scenario.observation.runs
    return {
        "turned, same time": {
            angles(turned): with_runs(scenario, turned)
            for turned in (parted(runs, n) for n in PARTS)
        },
        "turned, more time": {
            f"{length(turned)}: {angles(turned)}": with_runs(scenario, turned)
            for turned in (repeated(runs, n, TURN_DEG) for n in PARTS[1:])
        },
        "duration": {
            length(longer): with_runs(scenario, longer)
            for longer in (lasting(runs, cycles) for cycles in CYCLES)
        },
        "nights only": {
            length(longer): with_runs(scenario, at_night(longer))
            for longer in (repeated(runs, n, 0.0) for n in PARTS[:2])
        },
    }


Runs = tuple[RunSection, ...]


def changed(run: RunSection, **values: Any) -> RunSection:
    """A run with other values, checked again."""
    return RunSection(**{**run.model_dump(), **values})


def parted(runs: Sequence[RunSection], parts: int) -> Runs:
    """Every run in equal parts, each turned by 30 degrees more than the one before."""
    return tuple(
        changed(run, cycles=run.cycles / parts, turntable_deg=run.turntable_deg + part * TURN_DEG)
        for run in runs
        for part in range(parts)
    )


def repeated(runs: Sequence[RunSection], times: int, turn_deg: float) -> Runs:
    """All runs so many times, each time turned by ``turn_deg`` more."""
    return tuple(
        changed(run, turntable_deg=run.turntable_deg + number * turn_deg)
        for number in range(times)
        for run in runs
    )


def lasting(runs: Sequence[RunSection], cycles: float) -> Runs:
    """The runs, longer or shorter by one factor, so that they last ``cycles`` together."""
    factor = cycles / sum(run.cycles for run in runs)
    return tuple(changed(run, cycles=run.cycles * factor) for run in runs)


def at_night(runs: Sequence[RunSection]) -> Runs:
    """The runs with samples taken at night only."""
    return tuple(changed(run, night_only=True) for run in runs)


def angles(runs: Sequence[RunSection]) -> str:
    """Their turntable angles, in words."""
    return ", ".join(f"{run.turntable_deg:g}°" for run in runs)


def length(runs: Sequence[RunSection]) -> str:
    """How long they last, in words."""
    cycles = sum(run.cycles for run in runs)
    return f"{cycles:g} cycle{'' if cycles == 1.0 else 's'}"


def with_runs(scenario: Scenario, runs: Runs) -> Scenario:
    """The scenario with other runs."""
    observation = scenario.observation.model_copy(update={"runs": runs})
    return scenario.model_copy(update={"observation": observation})


def with_duty_cycle(scenario: Scenario, duty_cycle: float) -> Scenario:
    """The scenario with another duty cycle of the receivers."""
    radiometer = scenario.noise.radiometer.model_copy(update={"duty_cycle": duty_cycle})
    noise = scenario.noise.model_copy(update={"radiometer": radiometer})
    return scenario.model_copy(update={"noise": noise})
