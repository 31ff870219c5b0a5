"""Directions whose brightness summaries and spectra show."""

from __future__ import annotations

# Galactic longitude and latitude in degrees
LANDMARKS = {
    "Galactic centre": (0.0, 0.0),
    "anticentre": (180.0, 0.0),
    "north Galactic pole": (0.0, 90.0),
    "south Galactic pole": (0.0, -90.0),
}
