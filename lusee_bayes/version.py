"""The version of the package, and those of what its numbers depend on."""

from importlib import metadata

__version__ = "0.1.0"


def versions() -> dict[str, str]:
    """Versions of the package and of what its numbers depend on."""
    others = ("jax", "numpyro", "arviz-stats", "numpy", "scipy", "healpy", "astropy", "lunarsky")
    return {"lusee_bayes": __version__, **{name: metadata.version(name) for name in others}}
