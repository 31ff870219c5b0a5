"""The sky: the embedded Galaxy and its sources, and maps read from files."""

from lusee_bayes.sky.readers import read_map
from lusee_bayes.sky.sky import Sky, galaxy_sky, sky_from_file
from lusee_bayes.sky.sources import (
    BRIGHT_SOURCES,
    PointSource,
    galactic_unit_vector,
    kelvin_steradian,
)

__all__ = [
    "BRIGHT_SOURCES",
    "PointSource",
    "Sky",
    "galactic_unit_vector",
    "galaxy_sky",
    "kelvin_steradian",
    "read_map",
    "sky_from_file",
]
