"""Priors on the sky, m ~ N(mu, S): one class for each structure of S."""

from lusee_bayes.sky.priors.base import Prior
from lusee_bayes.sky.priors.dense import DensePrior
from lusee_bayes.sky.priors.harmonic import HarmonicPrior
from lusee_bayes.sky.priors.independent import DiagonalPrior, IndependentPrior
from lusee_bayes.sky.priors.pixels import PixelPrior

__all__ = [
    "DensePrior",
    "DiagonalPrior",
    "HarmonicPrior",
    "IndependentPrior",
    "PixelPrior",
    "Prior",
]
