"""What is in the diagnostics of a map."""

from __future__ import annotations

from pathlib import Path

from lusee_bayes.results.diagnostics_file import read_diagnostics


def describe_diagnostics(path: Path) -> str:
    """The diagnostics of a map."""
    found = read_diagnostics(path)
    kinds = found["group_kind"].values
    counts = [f"{int((kinds == kind).sum())} {kind}s" for kind in ("product", "day", "angle")]
    return "\n".join(
        [
            f"{path}: diagnostics of a map at {found.attrs['frequency_mhz']:g} MHz",
            f"  {found.attrs['verdict']}",
            f"  residuals by {', '.join(counts)}; {found.sizes['draw']} draws, "
            f"resolution of {found.sizes['mode']} modes",
        ]
    )
