"""Unknowns of instrument and sky, each marginalised into N or sampled."""

from lusee_bayes.systematics.base import (
    SKY,
    AdditiveNoise,
    Marginalised,
    Systematic,
    normal_within,
    uncertain_scale,
)
from lusee_bayes.systematics.beam_parameters import BeamError, InstrumentParameters
from lusee_bayes.systematics.chart import Chart
from lusee_bayes.systematics.gain_drifts import SCALES, GainDrifts
from lusee_bayes.systematics.noise_level import NoiseLevel
from lusee_bayes.systematics.point_sources import PointSources, Source
from lusee_bayes.systematics.pointing_offsets import PointingOffsets
from lusee_bayes.systematics.prior_spectrum import PowerSpectrum, SpectrumBands

__all__ = [
    "SCALES",
    "SKY",
    "AdditiveNoise",
    "BeamError",
    "Chart",
    "GainDrifts",
    "InstrumentParameters",
    "Marginalised",
    "NoiseLevel",
    "PointSources",
    "PointingOffsets",
    "PowerSpectrum",
    "Source",
    "SpectrumBands",
    "Systematic",
    "normal_within",
    "uncertain_scale",
]
