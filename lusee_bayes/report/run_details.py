"""How a run was made: scenario, versions, times, memory."""

from __future__ import annotations

from pathlib import Path

from lusee_bayes.report import html


def details(folder: Path, figures: dict) -> list[str]:
    """Tables of seconds and versions, and the resolved scenario."""
    seconds = [(name, f"{value:.2f} s") for name, value in figures["seconds"].items()]
    seconds.append(("peak memory", f"{figures['peak_memory_gb']:.2f} GB"))
    return [
        html.table(("stage", "time"), seconds),
        html.folded("versions", html.table(("package", "version"), figures["versions"].items())),
        html.folded(
            "the resolved scenario: running it again gives the same numbers",
            html.preformatted((folder / "scenario.yaml").read_text()),
        ),
    ]
