"""What is not known about instrument and sky, with two faces each: a term of N, or a site."""

from lusee_bayes.systematics.base import Marginalised, Systematic, normal_within, uncertain_scale
from lusee_bayes.systematics.gain_drifts import SCALES, GainDrifts
from lusee_bayes.systematics.instrument import BeamError, Instrument, InstrumentParameters
from lusee_bayes.systematics.levels import NoiseLevel, PowerSpectrum, SpectrumBands
from lusee_bayes.systematics.sources import PointSources, Source

__all__ = [
    "SCALES",
    "BeamError",
    "GainDrifts",
    "Instrument",
    "InstrumentParameters",
    "Marginalised",
    "NoiseLevel",
    "PointSources",
    "PowerSpectrum",
    "Source",
    "SpectrumBands",
    "Systematic",
    "normal_within",
    "uncertain_scale",
]
