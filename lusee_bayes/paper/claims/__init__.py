"""Every quantitative claim of the paper, section by section, each with its judge."""

from lusee_bayes.paper.claims import instrument, maps, observing, systematics
from lusee_bayes.paper.claims.base import (
    FREQUENCIES,
    SHOWN_FREQUENCIES,
    Cases,
    Claim,
    Verdict,
    cross,
    frequency_case,
    grade,
)

# in the order of the paper
CLAIMS: tuple[Claim, ...] = (
    *instrument.CLAIMS,
    *maps.CLAIMS,
    *systematics.CLAIMS,
    *observing.CLAIMS,
)

__all__ = [
    "CLAIMS",
    "FREQUENCIES",
    "SHOWN_FREQUENCIES",
    "Cases",
    "Claim",
    "Verdict",
    "cross",
    "frequency_case",
    "grade",
]
