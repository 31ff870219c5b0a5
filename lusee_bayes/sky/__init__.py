"""The sky: the embedded Galaxy and its sources, and skies read from files."""

from lusee_bayes.sky.alms import SkyAlms, write_alms
from lusee_bayes.sky.bright_sources import (
    BRIGHT_SOURCES,
    PointSource,
    galactic_unit_vector,
    kelvin_steradian,
)
from lusee_bayes.sky.cubes import SkyCube
from lusee_bayes.sky.files import SkyFile
from lusee_bayes.sky.maps import SkyMap
from lusee_bayes.sky.sky import Sky
from lusee_bayes.sky.source import (
    SKY_READERS,
    FileSource,
    GalaxySource,
    SkySource,
    galaxy_sky,
    read_sky_file,
    sky_from_file,
)

__all__ = [
    "BRIGHT_SOURCES",
    "SKY_READERS",
    "FileSource",
    "GalaxySource",
    "PointSource",
    "Sky",
    "SkyAlms",
    "SkyCube",
    "SkyFile",
    "SkyMap",
    "SkySource",
    "galactic_unit_vector",
    "galaxy_sky",
    "kelvin_steradian",
    "read_sky_file",
    "sky_from_file",
    "write_alms",
]
