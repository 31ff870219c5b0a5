"""Versions of the package and of the libraries that its numbers depend on."""

from importlib import metadata

__version__ = "0.1.0"


def versions() -> dict[str, str]:
    """Return the versions of the package and of the libraries that its numbers depend on."""
    libraries = ("jax", "numpyro", "arviz-stats", "numpy", "scipy", "healpy", "astropy", "lunarsky")
    return {"lusee_bayes": __version__, **{name: metadata.version(name) for name in libraries}}
