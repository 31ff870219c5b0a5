"""The sections of a scenario: what can be said, with which defaults, and what goes together."""

from lusee_bayes.experiment.schema.beam import (
    BEAM_SECTIONS,
    BeamSection,
    MonopoleBeamSection,
    ResponseSection,
    SampledBeamSection,
    ScalarBeamSection,
    section_of_file,
)
from lusee_bayes.experiment.schema.flight import FlightSection
from lusee_bayes.experiment.schema.flight_simulated import FlightSimulatedSection
from lusee_bayes.experiment.schema.noise import (
    BeamErrorSection,
    GainSection,
    NoiseAbout,
    NoiseSection,
    RadiometerSection,
)
from lusee_bayes.experiment.schema.observation import ObservationSection, RunSection
from lusee_bayes.experiment.schema.output import OutputSection
from lusee_bayes.experiment.schema.pointing import PointingSection
from lusee_bayes.experiment.schema.prior import (
    PRIOR_SECTIONS,
    IsotropicPriorSection,
    LocalScalesPriorSection,
    LogNormalSection,
    PriorSection,
)
from lusee_bayes.experiment.schema.section import Frequency, Section, Seed
from lusee_bayes.experiment.schema.sky import (
    SKY_SECTIONS,
    FileSkySection,
    GalaxySection,
    SkySection,
)
from lusee_bayes.experiment.schema.sources import SourceSection, SourcesSection
from lusee_bayes.experiment.schema.spectral import SpectralSection
from lusee_bayes.experiment.schema.unknowns import (
    GainTableSection,
    ReceiverNoiseSection,
    RegolithSection,
)

__all__ = [
    "BEAM_SECTIONS",
    "PRIOR_SECTIONS",
    "SKY_SECTIONS",
    "BeamErrorSection",
    "BeamSection",
    "FileSkySection",
    "FlightSection",
    "FlightSimulatedSection",
    "Frequency",
    "GainSection",
    "GainTableSection",
    "GalaxySection",
    "IsotropicPriorSection",
    "LocalScalesPriorSection",
    "LogNormalSection",
    "MonopoleBeamSection",
    "NoiseAbout",
    "NoiseSection",
    "ObservationSection",
    "OutputSection",
    "PointingSection",
    "PriorSection",
    "RadiometerSection",
    "ReceiverNoiseSection",
    "RegolithSection",
    "ResponseSection",
    "RunSection",
    "SampledBeamSection",
    "ScalarBeamSection",
    "Section",
    "Seed",
    "SkySection",
    "SourceSection",
    "SourcesSection",
    "SpectralSection",
    "section_of_file",
]
