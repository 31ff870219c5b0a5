"""Templates: skies that priors take their structure from."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from jaxtyping import Float

from lusee_bayes.core.arrays import Vector
from lusee_bayes.sky.galaxy import MAXIMUM_MHZ, Slabs, background, brightness, galaxy_map
from lusee_bayes.sky.sky_source import GalaxySource


def _towards(theta: np.ndarray, phi: np.ndarray) -> tuple[Slabs, tuple[np.ndarray, np.ndarray]]:
    """Lines of sight, the same at all frequencies, and the side and line of each direction."""
    return _slabs(np.stack([0.5 * np.pi - np.asarray(theta), phi]).astype(np.float64).tobytes())


@lru_cache(maxsize=1)
def _slabs(points: bytes) -> tuple[Slabs, tuple[np.ndarray, np.ndarray]]:
    latitude, longitude = np.frombuffer(points).reshape(2, -1)
    # lines of sight above and below the plane share what is symmetric: each once for both
    both, of_point = np.unique(
        np.stack([np.abs(latitude).round(12), longitude]), axis=1, return_inverse=True
    )
    places = (latitude < 0).astype(int), of_point.ravel()
    return Slabs.towards(np.degrees(both[1]), np.degrees(both[0])), places


def galactic_share(theta: Vector, phi: Vector) -> Vector:
    """Compute the Galaxy's share of the embedded diffuse sky, where it is transparent.

    The rest is the extragalactic background, which is the same everywhere.

    Parameters
    ----------
    theta, phi : (points,) array
        Galactic, in radians; theta from the north pole.
    """
    slabs, places = _towards(theta, phi)
    synchrotron, depth = slabs.synchrotron(MAXIMUM_MHZ)
    whole = brightness(synchrotron, depth, MAXIMUM_MHZ)
    return (1.0 - background(MAXIMUM_MHZ) * np.exp(-depth) / whole)[places]


class Template(ABC):
    """A brightness temperature in every direction, at one frequency."""

    @abstractmethod
    def at(self, theta: Vector, phi: Vector) -> Vector:
        """Compute it in Galactic directions.

        Parameters
        ----------
        theta, phi : (points,) array
            In radians; theta from the Galactic north pole.

        Returns
        -------
        (points,) array
            In K.
        """


@dataclass(frozen=True)
class EmbeddedTemplate(Template):
    """The embedded diffuse sky without its random component and without point sources.

    Attributes
    ----------
    frequency_mhz : float
        1 to 50 MHz.
    """

    frequency_mhz: float

    def at(self, theta, phi):
        slabs, places = _towards(theta, phi)
        return brightness(*slabs.synchrotron(self.frequency_mhz), self.frequency_mhz)[places]

    def pixels(self, nside: int) -> Float[np.ndarray, " pixels"]:
        """Compute it at the centres of HEALPix RING pixels, in K."""
        return galaxy_map(self.frequency_mhz, nside, seed=None)

    def modes(self, lmax: int) -> Float[np.ndarray, " modes"]:
        """Compute its real packed coefficients up to an ell, Galactic, in K."""
        return np.asarray(GalaxySource(None, ()).at(self.frequency_mhz, lmax).modes)
