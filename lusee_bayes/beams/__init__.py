"""From the electric fields of antennas to the beam of every correlation product."""

from lusee_bayes.beams.directions import beams_towards
from lusee_bayes.beams.fields import AntennaFields, displaced
from lusee_bayes.beams.files import read_beam
from lusee_bayes.beams.grid import HemisphereGrid
from lusee_bayes.beams.monopoles import Monopoles, monopole_beams
from lusee_bayes.beams.parameters import PARAMETERS, parameter, placed
from lusee_bayes.beams.product_beams import ProductBeams, product_beams, stokes_beam
from lusee_bayes.beams.receiver import Receiver
from lusee_bayes.beams.regolith import Regolith
from lusee_bayes.beams.response_file import PortResponse
from lusee_bayes.beams.scalar_file import ScalarBeam

__all__ = [
    "PARAMETERS",
    "AntennaFields",
    "HemisphereGrid",
    "Monopoles",
    "PortResponse",
    "ProductBeams",
    "Receiver",
    "Regolith",
    "ScalarBeam",
    "beams_towards",
    "displaced",
    "monopole_beams",
    "parameter",
    "placed",
    "product_beams",
    "read_beam",
    "stokes_beam",
]
