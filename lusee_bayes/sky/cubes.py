"""Sky maps of many frequencies: the layout of luseepy's ULSA file, which lowsky writes too.

FITS: one primary image (frequency, pixel) of HEALPix maps, RING, Galactic, K; the header has
FREQ_START, FREQ_END and FREQ_STEP in MHz. The file does not say its frame and order.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from lusee_bayes.core.errors import InputError
from lusee_bayes.core.formats import is_fits, opened
from lusee_bayes.core.layouts import Attribute, Layout, Variable
from lusee_bayes.core.lazy import healpy
from lusee_bayes.sky.files import SkyFile, modes_of_map

STEPS = ("FREQ_START", "FREQ_END", "FREQ_STEP")
LAYOUT = Layout(
    "sky maps of many frequencies: an image (frequency, pixel)",
    {"maps": Variable(("frequency", "pixel"), unit="K")},
    {
        "FREQ_START": Attribute(low=0.0, unit="MHz"),
        "FREQ_END": Attribute(low=0.0, unit="MHz"),
        "FREQ_STEP": Attribute(low=1e-6, unit="MHz"),
    },
)


@dataclass(frozen=True)
class SkyCube(SkyFile):
    """Maps of several frequencies.

    Attributes
    ----------
    path : str
        The file, for messages.
    frequencies_mhz : (frequencies,) array
        Growing in equal steps.
    pixels : (frequencies, pixels) array
        HEALPix RING, Galactic, in K.
    """

    path: str
    frequencies_mhz: Float[np.ndarray, " frequencies"]
    pixels: Float[np.ndarray, "frequencies pixels"]

    @classmethod
    def recognises(cls, path: Path) -> bool:
        if not is_fits(path):
            return False
        with opened(path) as hdus:
            return all(key in hdus[0].header for key in STEPS)

    @classmethod
    def read(cls, path: str | Path, dataset: str | None = None) -> SkyCube:
        """Read a file of maps of many frequencies.

        Raises
        ------
        InputError
            For a truncated file, steps of frequency that do not fit the maps, maps that are not
            HEALPix, and numbers that are not finite.
        """
        with opened(path, "sky maps of many frequencies") as hdus:
            there = {} if hdus[0].data is None else {"maps": hdus[0].data}
            header = dict(hdus[0].header)
            found = LAYOUT.checked(path, there, header | {"maps.units": header.get("BUNIT")})
        start, end, step = (found.values[key] for key in STEPS)
        pixels = found.arrays["maps"]
        count = round((end - start) / step) + 1
        if len(pixels) != count:
            raise InputError(
                f"{path}: the image has shape {pixels.shape}, expected {count} maps for {start:g} "
                f"to {end:g} MHz in steps of {step:g}"
            )
        if not healpy.isnpixok(pixels.shape[1]):
            raise InputError(
                f"{path}: {pixels.shape[1]} values are not a HEALPix map of 12 NSIDE^2"
            )
        return cls(str(path), start + step * np.arange(count), pixels)

    def map_at(self, frequency_mhz: float) -> Float[np.ndarray, " pixels"]:
        """Return the map at a frequency; between two maps, by the power law of each pixel.

        Parameters
        ----------
        frequency_mhz : float
            Frequency in MHz.

        Returns
        -------
        (pixels,) array
            HEALPix RING, Galactic, in K.

        Raises
        ------
        InputError
            Outside the file's frequencies, or where a pixel between two frequencies is not
            positive in both.
        """
        known = self.frequencies_mhz
        if not known[0] <= frequency_mhz <= known[-1]:
            raise InputError(
                f"{self.path} has maps from {known[0]:g} to {known[-1]:g} MHz, not at "
                f"{frequency_mhz:g}; set sky.file_frequency_mhz to one of those, and it is scaled "
                "with sky.spectral_index"
            )
        above = int(np.searchsorted(known, frequency_mhz))
        if known[above] == frequency_mhz:
            return self.pixels[above]
        low, high = self.pixels[above - 1], self.pixels[above]
        if not ((low > 0) & (high > 0)).all():
            raise InputError(
                f"{self.path} has pixels that are not positive at {known[above - 1]:g} or "
                f"{known[above]:g} MHz, between which there is no power law; take a frequency of "
                "the file"
            )
        share = np.log(frequency_mhz / known[above - 1]) / np.log(known[above] / known[above - 1])
        return low * (high / low) ** share

    def modes_at(self, frequency_mhz: float, lmax: int) -> Float[np.ndarray, " modes"]:
        return modes_of_map(self.path, self.map_at(frequency_mhz), lmax)

    def summary(self) -> tuple[str, ...]:
        known, pixels = self.frequencies_mhz, self.pixels
        return (
            f"{len(pixels)} HEALPix sky maps, NSIDE {healpy.npix2nside(pixels.shape[1])}, taken "
            "to be RING and Galactic",
            f"{known[0]:g} to {known[-1]:g} MHz, means {pixels[0].mean():.6g} to "
            f"{pixels[-1].mean():.6g} K, least pixel {pixels.min():.4g} K",
        )
