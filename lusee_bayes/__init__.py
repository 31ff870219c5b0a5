"""Bayesian map-making for LuSEE-Night: from visibilities to a posterior over sky maps.

    d = A m + n,    m ~ N(0, S),    n ~ N(0, N)

    A   CouplingMatrix   beams of an Observation, turned with the Moon (ProductBeams, Pointing)
    m   Sky              real harmonic coefficients, Galactic, in K
    S   HarmonicPrior    diag(C_ell)
    N   Covariance       radiometer_noise, ... composed with +
    d   Visibilities     16 products per time, in K

LinearGaussian(A, S, N).condition(d) is the Posterior: its mean, std, covariance and draws.
Importing the package switches JAX to 64 bit: Lambda's condition number is about 1e10.
"""

import importlib

import jax

from lusee_bayes.checks import InputError
from lusee_bayes.version import __version__

jax.config.update("jax_enable_x64", True)

# loaded when first used: healpy, lunarsky and xarray take seconds together
_HOMES = {
    "CorrelatedNormal": "sites",
    "CompactPosterior": "compact",
    "CouplingMatrix": "coupling",
    "Covariance": "covariance",
    "DenseCovariance": "covariance",
    "DiagonalCovariance": "covariance",
    "Experiment": "experiment",
    "GainDrift": "noise",
    "HarmonicPrior": "prior",
    "Information": "information",
    "LowRankCovariance": "covariance",
    "LinearGaussian": "linear_gaussian",
    "MapResult": "results",
    "Marginal": "sites",
    "Monopoles": "beams",
    "Observation": "observation",
    "PixelPrior": "prior",
    "Pointing": "pointing",
    "Posterior": "posterior",
    "ProductBeams": "beams",
    "Regolith": "beams",
    "Run": "observation",
    "Sampler": "inference",
    "Scenario": "scenario",
    "Sky": "sky",
    "SkyPrior": "sites",
    "SpectralPrior": "spectral_prior",
    "TimeBandedCovariance": "covariance",
    "TimeBlockCovariance": "covariance",
    "Visibilities": "visibilities",
    "Instrument": "systematics",
    "Systematic": "systematics",
    "Whitened": "coordinates",
    "Whitening": "coordinates",
    "calibrate": "calibration",
    "calibrate_sky": "calibration",
    "compare": "validation",
    "evidence": "comparison",
    "laplace": "laplace",
    "galaxy_sky": "sky",
    "load_program": "programs",
    "load_scenario": "scenario",
    "monopole_beams": "beams",
    "radiometer_noise": "noise",
    "read_beam": "beams",
    "read_compact": "compact",
    "read_visibilities": "visibilities",
    "read_waterfall": "waterfalls",
    "sample": "inference",
    "solve_directly": "joint",
    "solve_iteratively": "iterative_joint",
    "updated": "updating",
    "beam_error_noise": "noise",
    "template_noise": "noise",
    "sky_from_file": "sky",
    "write_waterfall": "waterfalls",
}

__all__ = ["InputError", "__version__", *sorted(_HOMES)]


def __getattr__(name: str):
    if name not in _HOMES:
        raise AttributeError(f"module 'lusee_bayes' has no attribute '{name}'")
    value = getattr(importlib.import_module(f"lusee_bayes.{_HOMES[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *_HOMES})
