"""From the electric fields of antennas to the beam of every correlation product."""

from lusee_bayes.instrument.beams.directions import beams_towards
from lusee_bayes.instrument.beams.fields import AntennaFields, displaced
from lusee_bayes.instrument.beams.files import read_beam
from lusee_bayes.instrument.beams.grid import HemisphereGrid
from lusee_bayes.instrument.beams.monopoles import Monopoles, monopole_beams
from lusee_bayes.instrument.beams.parameters import PARAMETERS, parameter, placed
from lusee_bayes.instrument.beams.product_beams import ProductBeams, product_beams, stokes_beam
from lusee_bayes.instrument.beams.receiver import (
    CapacitorReceiver,
    JFETReceiver,
    MeasuredReceiver,
    Receiver,
    read_receiver,
)
from lusee_bayes.instrument.beams.regolith import Regolith
from lusee_bayes.instrument.beams.response_file import PortResponse
from lusee_bayes.instrument.beams.sampled import SampledBeams, sampled_beams
from lusee_bayes.instrument.beams.sampled_file import write_sampled_beams
from lusee_bayes.instrument.beams.sampled_source import SampledFileBeams
from lusee_bayes.instrument.beams.scalar_file import ScalarBeam
from lusee_bayes.instrument.beams.source import (
    BeamSource,
    EmbeddedBeams,
    ResponseBeams,
    ScalarFileBeams,
)
from lusee_bayes.instrument.beams.uvbeam import from_uvbeam

__all__ = [
    "PARAMETERS",
    "AntennaFields",
    "BeamSource",
    "CapacitorReceiver",
    "EmbeddedBeams",
    "HemisphereGrid",
    "JFETReceiver",
    "MeasuredReceiver",
    "Monopoles",
    "PortResponse",
    "ProductBeams",
    "Receiver",
    "Regolith",
    "ResponseBeams",
    "SampledBeams",
    "SampledFileBeams",
    "ScalarBeam",
    "ScalarFileBeams",
    "beams_towards",
    "displaced",
    "from_uvbeam",
    "monopole_beams",
    "parameter",
    "placed",
    "product_beams",
    "read_beam",
    "read_receiver",
    "sampled_beams",
    "stokes_beam",
    "write_sampled_beams",
]
