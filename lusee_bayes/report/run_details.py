"""How a run was made: scenario, versions, times, memory."""

from __future__ import annotations

from pathlib import Path

from lusee_bayes.core.errors import InputError
from lusee_bayes.core.reading import read_text
from lusee_bayes.report import html


def details(folder: Path, figures: dict) -> list[str]:
    """Tables of seconds and versions, and the resolved scenario."""
    scenario = read_text(folder / "scenario.yaml", "a scenario")
    for name in ("seconds", "versions"):
        if not isinstance(figures.get(name), dict):
            raise InputError(f"the figures of the run in '{folder}' have no {name}; make it again")
    seconds = [(name, f"{value} s") for name, value in figures["seconds"].items()]
    seconds.append(("peak memory", f"{figures['peak_memory_gb']:.2f} GB"))
    return [
        html.table(("stage", "time"), seconds),
        html.folded("versions", html.table(("package", "version"), figures["versions"].items())),
        html.folded(
            "the resolved scenario: running it again gives the same numbers",
            html.preformatted(scenario),
        ),
    ]
