"""The terms of N: covariances of what the instrument adds to the visibilities of the sky."""

from lusee_bayes.noise.beam_error import (
    beam_error_noise,
    derivative,
    difference,
    rms_difference,
)
from lusee_bayes.noise.gain_drift import GainDrift, white_grid, with_gains
from lusee_bayes.noise.radiometer import exact_blocks, paper_variance, radiometer_noise
from lusee_bayes.noise.templates import template_noise

__all__ = [
    "GainDrift",
    "beam_error_noise",
    "derivative",
    "difference",
    "exact_blocks",
    "paper_variance",
    "radiometer_noise",
    "rms_difference",
    "template_noise",
    "white_grid",
    "with_gains",
]
