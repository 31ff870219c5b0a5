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
from lusee_bayes.systematics.gain_table import GAIN_TABLE, GainTable, TableErrors
from lusee_bayes.systematics.linear_unknowns import LinearUnknowns
from lusee_bayes.systematics.noise_level import NoiseLevel
from lusee_bayes.systematics.point_sources import PointSources, Source
from lusee_bayes.systematics.pointing_offsets import PointingOffsets
from lusee_bayes.systematics.prior_spectrum import PowerSpectrum, SpectrumBands
from lusee_bayes.systematics.templated import Expanded, Templated

__all__ = [
    "GAIN_TABLE",
    "SCALES",
    "SKY",
    "AdditiveNoise",
    "BeamError",
    "Chart",
    "Expanded",
    "GainDrifts",
    "GainTable",
    "InstrumentParameters",
    "LinearUnknowns",
    "Marginalised",
    "NoiseLevel",
    "PointSources",
    "PointingOffsets",
    "PowerSpectrum",
    "Source",
    "SpectrumBands",
    "Systematic",
    "TableErrors",
    "Templated",
    "normal_within",
    "uncertain_scale",
]
