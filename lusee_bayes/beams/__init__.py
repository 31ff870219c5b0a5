"""From the electric fields of antennas to the beam of every correlation product."""

from lusee_bayes.beams.directions import beams_towards
from lusee_bayes.beams.fields import AntennaFields, displaced
from lusee_bayes.beams.files import BeamFile, read_beam
from lusee_bayes.beams.grid import HemisphereGrid
from lusee_bayes.beams.monopoles import Monopoles, monopole_beams
from lusee_bayes.beams.parameters import PARAMETERS, parameter, placed
from lusee_bayes.beams.product_beams import ProductBeams, product_beams, stokes_beam
from lusee_bayes.beams.regolith import Regolith

__all__ = [
    "PARAMETERS",
    "AntennaFields",
    "BeamFile",
    "HemisphereGrid",
    "Monopoles",
    "ProductBeams",
    "Regolith",
    "beams_towards",
    "displaced",
    "monopole_beams",
    "parameter",
    "placed",
    "product_beams",
    "read_beam",
    "stokes_beam",
]
