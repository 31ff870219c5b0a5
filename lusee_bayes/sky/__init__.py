"""The sky: the embedded Galaxy and its sources, and maps read from files."""

from lusee_bayes.sky.readers import read_map
from lusee_bayes.sky.sky import Sky, galaxy_sky, sky_from_file
from lusee_bayes.sky.sources import BRIGHT_SOURCES, PointSource

__all__ = ["BRIGHT_SOURCES", "PointSource", "Sky", "galaxy_sky", "read_map", "sky_from_file"]
