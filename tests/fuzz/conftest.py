"""Inputs that nobody has thought of: a few in each run, many in the long one."""

from __future__ import annotations

import changes
import pytest
from hypothesis import HealthCheck, Phase, settings

settings.register_profile(
    "here",
    database=None,
    deadline=None,
    derandomize=True,
    # an example of two changes needs no smaller one, and finding it takes minutes
    phases=[Phase.explicit, Phase.generate],
    suppress_health_check=list(HealthCheck),
)
settings.load_profile("here")


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """How many inputs were tried."""
    if changes.TRIED:
        terminalreporter.section("inputs tried")
        for what, number in sorted(changes.TRIED.items()):
            terminalreporter.line(f"{number:7d}  {what}")
        terminalreporter.line(f"{changes.TRIED.total():7d}  in all")
