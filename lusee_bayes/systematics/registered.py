"""The systematics that a scenario may have, and its section ``noise``, which follows from them.

To add one, add a file beside this one, and a line here.
"""

from operator import attrgetter
from typing import Any

from pydantic import create_model

from lusee_bayes.core.section import Section
from lusee_bayes.systematics.above_lmax import AboveLmax
from lusee_bayes.systematics.beam import BeamErrors
from lusee_bayes.systematics.field_errors import FieldErrors
from lusee_bayes.systematics.gain_drifts import GainDrifts
from lusee_bayes.systematics.gain_table import GainTable
from lusee_bayes.systematics.horizon import Horizon
from lusee_bayes.systematics.noise_level import NoiseLevel, RadiometerSection
from lusee_bayes.systematics.pointing_offsets import PointingOffsets
from lusee_bayes.systematics.polarisation import Polarisation
from lusee_bayes.systematics.prior_spectrum import PriorSpectrum
from lusee_bayes.systematics.receivers import Receivers
from lusee_bayes.systematics.regolith import RegolithTemperature
from lusee_bayes.systematics.sources import PointSources
from lusee_bayes.systematics.systematic import Systematic

# in the order in which they are applied to the model
SYSTEMATICS: tuple[type[Systematic], ...] = (
    NoiseLevel, PriorSpectrum, BeamErrors, FieldErrors, Horizon, PointingOffsets, AboveLmax,
    PointSources, Receivers, RegolithTemperature, Polarisation,
    GainTable, GainDrifts,
)  # fmt: skip

_TERMS = {
    cls.key.removeprefix("noise."): (cls.section | None, None)
    for cls in SYSTEMATICS
    if cls.key.startswith("noise.")
} | {"radiometer": (RadiometerSection, RadiometerSection())}
# every systematic ``noise.KEY`` is an entry
NoiseSection = create_model(
    "NoiseSection",
    __base__=Section,
    __doc__="The terms of N; a term that is left out is neither in the data nor in N.",
    __module__=__name__,
    **_TERMS,
)


def present(scenario: Any) -> list[tuple[type[Systematic], Any]]:
    """The systematics that a scenario has, with their sections."""
    classes = [cls for cls in SYSTEMATICS if cls.treatment(scenario) is not None]
    return [(cls, attrgetter(cls.key)(scenario)) for cls in classes]
