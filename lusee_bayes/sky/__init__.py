"""The sky: the embedded Galaxy and its sources, and maps read from files."""

from lusee_bayes.sky.alms import SkyAlms, read_alms, write_alms
from lusee_bayes.sky.cubes import SkyCube, read_cube
from lusee_bayes.sky.readers import read_map
from lusee_bayes.sky.sky import Sky, galaxy_sky, sky_from_file, sky_kind
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
    "SkyAlms",
    "SkyCube",
    "galactic_unit_vector",
    "galaxy_sky",
    "kelvin_steradian",
    "read_alms",
    "read_cube",
    "read_map",
    "sky_from_file",
    "sky_kind",
    "write_alms",
]
