"""The systematics of a scenario, by the sections that ask for them.

A new one is a :class:`Systematic`, its section in the schema, and its line in ``TERMS``.
"""

from __future__ import annotations

from lusee_bayes.experiment.instrument_terms import (
    BeamErrorTerm,
    GainTableTerm,
    GainTerm,
    PointingTerm,
)
from lusee_bayes.experiment.sky_terms import (
    NoiseLevelTerm,
    PriorSpectrumTerm,
    ReceiverTerm,
    RegolithTerm,
    SourcesTerm,
)
from lusee_bayes.experiment.term import Term

# in the order in which they are applied to the model, and to simulated visibilities
TERMS: tuple[Term, ...] = (
    NoiseLevelTerm(),
    PriorSpectrumTerm(),
    PointingTerm(),
    BeamErrorTerm(),
    SourcesTerm(),
    ReceiverTerm(),
    RegolithTerm(),
    GainTableTerm(),
    GainTerm(),
)
