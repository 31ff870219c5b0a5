"""The systematics of a scenario: how each is built, and what simulated data hold of it.

A new one is a :class:`Systematic`, its section in the schema, and its line in ``TERMS``.
"""

from lusee_bayes.experiment.terms.beam_error import (
    BeamErrorTerm,
    beam_directions,
    beam_rms_difference,
    true_beams,
    true_instrument,
)
from lusee_bayes.experiment.terms.gain_drift import GainTerm, gain_drifts
from lusee_bayes.experiment.terms.gain_table import GainTableTerm, table_factors
from lusee_bayes.experiment.terms.noise_about import (
    gains_about,
    noise_visibilities,
    radiometer_about,
)
from lusee_bayes.experiment.terms.noise_level import NoiseLevelTerm
from lusee_bayes.experiment.terms.pointing import (
    PointingTerm,
    offsets_about,
    pointed,
    pointing_offsets,
    second_order,
    true_setup,
)
from lusee_bayes.experiment.terms.prior_spectrum import PriorSpectrumTerm
from lusee_bayes.experiment.terms.receiver import ReceiverTerm
from lusee_bayes.experiment.terms.regolith import RegolithTerm
from lusee_bayes.experiment.terms.sources import SourcesTerm, point_sources
from lusee_bayes.experiment.terms.term import AdditiveTerm, Around, Term, Truth

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

__all__ = [
    "TERMS",
    "AdditiveTerm",
    "Around",
    "PointingTerm",
    "Term",
    "Truth",
    "beam_directions",
    "beam_rms_difference",
    "gain_drifts",
    "gains_about",
    "noise_visibilities",
    "offsets_about",
    "point_sources",
    "pointed",
    "pointing_offsets",
    "radiometer_about",
    "second_order",
    "table_factors",
    "true_beams",
    "true_instrument",
    "true_setup",
]
