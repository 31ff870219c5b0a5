"""Levels of central intervals, in one place for all that counts coverage."""

from __future__ import annotations

# of the intervals whose coverage is counted
LEVELS = (0.50, 0.68, 0.90, 0.95)


# names of the levels in files
NAMES = tuple(f"{100 * level:.0f}" for level in LEVELS)
