"""The systematics of a scenario, by the sections that ask for them.

A new one is a :class:`Systematic`, its section in the schema, and its line in ``TERMS``.
"""

from __future__ import annotations

from lusee_bayes.experiment import instrument_terms, sky_terms
from lusee_bayes.experiment.term import Term

# in the order in which they are applied to the model, and to simulated visibilities
TERMS: tuple[Term, ...] = (
    sky_terms.NoiseLevelTerm(),
    sky_terms.PriorSpectrumTerm(),
    instrument_terms.PointingTerm(),
    instrument_terms.BeamErrorTerm(),
    sky_terms.SourcesTerm(),
    sky_terms.ReceiverTerm(),
    sky_terms.RegolithTerm(),
    instrument_terms.GainTableTerm(),
    instrument_terms.GainTerm(),
)
