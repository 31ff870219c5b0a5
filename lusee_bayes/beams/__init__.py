"""From the electric fields of antennas to the beam of every correlation product."""

from lusee_bayes.beams.fields import AntennaFields, displaced
from lusee_bayes.beams.grid import HemisphereGrid
from lusee_bayes.beams.monopoles import Monopoles, monopole_beams
from lusee_bayes.beams.product_beams import ProductBeams, product_beams, stokes_beam
from lusee_bayes.beams.regolith import Regolith

__all__ = [
    "AntennaFields",
    "HemisphereGrid",
    "Monopoles",
    "ProductBeams",
    "Regolith",
    "displaced",
    "monopole_beams",
    "product_beams",
    "stokes_beam",
]
