"""Noise covariances: one protocol, one file per structure, composed with ``+``."""

from lusee_bayes.covariance.base import Covariance, Factor
from lusee_bayes.covariance.dense import DenseCovariance
from lusee_bayes.covariance.diagonal import DiagonalCovariance
from lusee_bayes.covariance.low_rank import LowRankCovariance, LowRankUpdate
from lusee_bayes.covariance.time_banded import TimeBandedCovariance
from lusee_bayes.covariance.time_blocks import TimeBlockCovariance

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
