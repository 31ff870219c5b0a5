"""Libraries that are slow to import and rarely needed: imported when first used.

``importlib.util.LazyLoader``, used by lazy_loader, leaves an unfinished module in ``sys.modules``.
Any search through it finishes that module, in the middle of other imports. These are plain objects.
"""

from importlib import import_module
from typing import Any


class LazyModule:
    """A module that is imported when one of its names is first used.

    Parameters
    ----------
    name : str
        Name of the module.
    """

    def __init__(self, name: str):
        self._name = name

    def __getattr__(self, name: str) -> Any:
        return getattr(import_module(self._name), name)


# healpy imports matplotlib and astropy.coordinates
healpy = LazyModule("healpy")
coordinates = LazyModule("astropy.coordinates")
# for checks of whether a value is traced, and for printing numbers
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
