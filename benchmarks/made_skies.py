"""Skies that no prior of the package draws: one too smooth for it, and one too spotty.

Error bars have to hold for them, too. Both are positive, of about the Galaxy's brightness, and
have the same pattern at all frequencies.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from lusee_bayes.core.harmonics import map_to_modes, synthesis_matrix
from lusee_bayes.core.lazy import healpy
from lusee_bayes.sky.sky_source import Sky, SkySource

# of the patterns, that of the mean sky; finer than they are wide
NSIDE = 64
# mean brightness in K at the reference frequency, and its spectral index
BRIGHTNESS, REFERENCE_MHZ, INDEX = 3e5, 10.0, -2.5
# share of the brightness that is in compact sources, their number, and the index of N(> flux)
IN_SOURCES, SOURCES, COUNT_SLOPE = 0.1, 3000, -1.5


def brightness(frequency_mhz: float) -> float:
    """Compute the mean brightness of both skies, in K."""
    return BRIGHTNESS * (frequency_mhz / REFERENCE_MHZ) ** INDEX


@dataclass(frozen=True)
class SmoothSky(SkySource):
    """A broad band, tilted against the Galactic plane, with a few wide blobs; nothing small.

    Attributes
    ----------
    seed : int
        Of the places, widths and brightnesses of the blobs.
    """

    seed: int = 1

    def pattern(self) -> Float[np.ndarray, " pixels"]:
        """Compute the map, HEALPix RING, with mean 1."""
        rng = np.random.default_rng(self.seed)
        directions = _directions()
        pole = _unit(np.radians(30.0), rng.uniform(0.0, 2.0 * np.pi))
        height = np.degrees(np.arcsin(pole @ directions))
        pattern = 0.4 + 1.2 * np.exp(-0.5 * (height / 25.0) ** 2)
        for _ in range(6):
            centre = _unit(np.arccos(rng.uniform(-1.0, 1.0)), rng.uniform(0.0, 2.0 * np.pi))
            width = np.radians(rng.uniform(15.0, 30.0))
            pattern += rng.uniform(0.3, 1.0) * np.exp((centre @ directions - 1.0) / width**2)
        return pattern / pattern.mean()

    def at(self, frequency_mhz: float, lmax: int) -> Sky:
        modes = brightness(frequency_mhz) * map_to_modes(self.pattern(), lmax)
        return Sky(modes, float(frequency_mhz), "smooth sky")


@dataclass(frozen=True)
class SpottySky(SkySource):
    """Compact sources with a steep number count over a faint background with a plane.

    Half of the sources are anywhere, half within some degrees of the Galactic plane.

    Attributes
    ----------
    seed : int
        Of the sources.
    """

    seed: int = 1

    def background(self) -> Float[np.ndarray, " pixels"]:
        """Compute what is not in sources, HEALPix RING, with mean 1."""
        x, _, z = _directions()
        latitude = np.degrees(np.arcsin(z))
        plane = np.exp(-0.5 * (latitude / 12.0) ** 2)
        pattern = 1.0 + 0.2 * x + (1.5 + 0.7 * x) * plane
        return pattern / pattern.mean()

    def sources(
        self,
    ) -> tuple[
        Float[np.ndarray, " sources"], Float[np.ndarray, " sources"], Float[np.ndarray, " sources"]
    ]:
        """Draw colatitude and longitude of every source, in radians, and its share of the flux."""
        rng = np.random.default_rng(self.seed)
        half = SOURCES // 2
        height = np.concatenate(
            [rng.uniform(-1.0, 1.0, half), np.sin(rng.laplace(0.0, np.radians(4.0), half))]
        )
        flux = rng.uniform(size=2 * half) ** (1.0 / COUNT_SLOPE)
        return np.arccos(height), rng.uniform(0.0, 2.0 * np.pi, 2 * half), flux / flux.sum()

    def at(self, frequency_mhz: float, lmax: int) -> Sky:
        theta, phi, share = self.sources()
        # sources that cover the sky evenly with a mean of 1 K have 4 pi K sr together
        spots = 4.0 * np.pi * share @ synthesis_matrix(theta, phi, lmax)
        smooth = map_to_modes(self.background(), lmax)
        pattern = (1.0 - IN_SOURCES) * smooth + IN_SOURCES * spots
        return Sky(brightness(frequency_mhz) * pattern, float(frequency_mhz), "spotty sky")


def _directions() -> Float[np.ndarray, "3 pixels"]:
    return np.array(healpy.pix2vec(NSIDE, np.arange(healpy.nside2npix(NSIDE))))


def _unit(theta: float, phi: float) -> Float[np.ndarray, "3"]:
    return np.array([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)])
