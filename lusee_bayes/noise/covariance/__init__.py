"""Noise covariances: one protocol, one file for each structure, composed with ``+``."""

from lusee_bayes.noise.covariance.base import Covariance, Factor
from lusee_bayes.noise.covariance.dense import DenseCovariance
from lusee_bayes.noise.covariance.diagonal import DiagonalCovariance
from lusee_bayes.noise.covariance.low_rank import LowRankCovariance, LowRankUpdate
from lusee_bayes.noise.covariance.time_banded import TimeBandedCovariance
from lusee_bayes.noise.covariance.time_blocks import TimeBlockCovariance

__all__ = [
    "Covariance",
    "DenseCovariance",
    "DiagonalCovariance",
    "Factor",
    "LowRankCovariance",
    "LowRankUpdate",
    "TimeBandedCovariance",
    "TimeBlockCovariance",
]
