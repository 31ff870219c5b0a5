"""Libraries that take long to import and that most uses do without: imported when first used.

``importlib.util.LazyLoader``, on which lazy_loader builds, puts an unfinished module where every
search through ``sys.modules`` finishes it, in the middle of other imports; these are plain objects.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any


class LazyModule:
    """A module that is imported when one of its names is first asked for.

    Parameters
    ----------
    name : str
        Of the module.
    """

    def __init__(self, name: str):
        self._name = name

    def __getattr__(self, name: str) -> Any:
        return getattr(import_module(self._name), name)


# healpy brings matplotlib and astropy.coordinates with it
healpy = LazyModule("healpy")
coordinates = LazyModule("astropy.coordinates")
# for whoever checks whether something is traced, and shows numbers
jax = LazyModule("jax")
numpyro = LazyModule("numpyro")
interpolate = LazyModule("scipy.interpolate")
units = LazyModule("astropy.units")
fits = LazyModule("astropy.io.fits")
astropy_exceptions = LazyModule("astropy.utils.exceptions")
pandas = LazyModule("pandas")
xarray = LazyModule("xarray")
special = LazyModule("scipy.special")
rotations = LazyModule("scipy.spatial.transform")
arviz_stats = LazyModule("arviz_stats.base")
# an optional extra
pyuvdata = LazyModule("pyuvdata")
dist = LazyModule("numpyro.distributions")
