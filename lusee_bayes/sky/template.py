"""Templates: skies that priors take their structure from.

The embedded diffuse sky, a sky file, or the mean of another channel's posterior.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from lusee_bayes.core import formats
from lusee_bayes.core.errors import InputError
from lusee_bayes.core.harmonics import (
    azimuth_functions,
    lmax_of,
    mode_numbers,
    n_modes,
    polar_functions,
)
from lusee_bayes.core.layouts import Attribute, Layout, Variable
from lusee_bayes.core.lazy import healpy
from lusee_bayes.core.netcdf_files import read_netcdf
from lusee_bayes.core.sphere_grid import SphereGrid
from lusee_bayes.sky.galaxy import MAXIMUM_MHZ, Slabs, background, brightness, galaxy_map
from lusee_bayes.sky.source import GalaxySource, read_sky_file

POSTERIOR = Layout(
    "a posterior of lusee-bayes map",
    {"mean": Variable(("mode",))},
    {"frequency_mhz": Attribute(low=0.0, unit="MHz")},
)
# of the grid: what it does not resolve of a template folds back into its coefficients
LEAST_BAND = 128
# points whose azimuthal functions are kept at once
CHUNK = 20_000


@lru_cache(maxsize=1)
def _slabs(points: bytes) -> tuple[Slabs, Int[np.ndarray, " points"]]:
    """Lines of sight, the same at all frequencies, and the line of each latitude and longitude."""
    latitude, longitude = np.frombuffer(points).reshape(2, -1)
    # lines of sight above and below the plane share what is symmetric: each once for both
    both, of_point = np.unique(
        np.stack([np.abs(latitude).round(12), longitude]), axis=1, return_inverse=True
    )
    return Slabs.towards(np.degrees(both[1]), np.degrees(both[0])), of_point.ravel()


def galactic_share(
    theta: Float[np.ndarray, " points"], phi: Float[np.ndarray, " points"]
) -> Float[np.ndarray, " points"]:
    """Compute the Galaxy's share of the embedded diffuse sky, where it is transparent.

    The rest is the extragalactic background, which is the same everywhere.

    Parameters
    ----------
    theta, phi : (points,) array
        Galactic, in radians; theta from the north pole.
    """
    points = np.stack([0.5 * np.pi - np.asarray(theta), phi]).astype(np.float64)
    slabs, of_point = _slabs(points.tobytes())
    synchrotron, depth = slabs.synchrotron(MAXIMUM_MHZ)
    whole = brightness(synchrotron, depth, MAXIMUM_MHZ)
    share = 1.0 - background(MAXIMUM_MHZ) * np.exp(-depth) / whole
    return share[(points[0] < 0).astype(int), of_point]


class Template(ABC):
    """A brightness temperature in every direction, at one frequency."""

    @abstractmethod
    def at(
        self, theta: Float[np.ndarray, " points"], phi: Float[np.ndarray, " points"]
    ) -> Float[np.ndarray, " points"]:
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

    def modes(self, lmax: int) -> Float[np.ndarray, " modes"]:
        """Compute its real packed coefficients up to an ell, Galactic, in K.

        By integrals over a grid, if it does not know better.

        Raises
        ------
        InputError
            If it has none up to this ell.
        """
        grid = SphereGrid.of(lmax, max(3 * lmax, LEAST_BAND))
        return grid.analyse(self.at(*grid.directions()).reshape(grid.shape))

    def pixels(self, nside: int) -> Float[np.ndarray, " pixels"]:
        """Compute it at the centres of HEALPix RING pixels, in K."""
        return self.at(*healpy.pix2ang(nside, np.arange(healpy.nside2npix(nside))))


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
        points = np.stack([0.5 * np.pi - np.asarray(theta), phi]).astype(np.float64)
        slabs, of_point = _slabs(points.tobytes())
        sides = brightness(*slabs.synchrotron(self.frequency_mhz), self.frequency_mhz)
        return sides[(points[0] < 0).astype(int), of_point]

    def pixels(self, nside):
        return galaxy_map(self.frequency_mhz, nside, seed=None)

    def modes(self, lmax):
        return np.asarray(GalaxySource(None, ()).at(self.frequency_mhz, lmax).modes)


@dataclass(frozen=True, eq=False)
class HarmonicTemplate(Template):
    """A template of limited resolution.

    Attributes
    ----------
    coefficients : (modes,) array
        Real packed, Galactic, in K.
    """

    coefficients: Float[np.ndarray, " modes"]

    def modes(self, lmax):
        if len(self.coefficients) < n_modes(lmax):
            raise InputError(
                f"the template has coefficients up to ell = {lmax_of(len(self.coefficients))}, not "
                f"up to {lmax}; lower lmax"
            )
        return self.coefficients[: n_modes(lmax)]

    def at(self, theta, phi):
        lmax = lmax_of(len(self.coefficients))
        heights, ring = np.unique(np.asarray(theta), return_inverse=True)
        _, m = mode_numbers(lmax)
        by_order = np.argsort(m, kind="stable")
        starts = np.searchsorted(m[by_order], np.arange(-lmax, lmax + 1))
        weighted = polar_functions(heights, lmax) * self.coefficients
        orders = np.add.reduceat(weighted[:, by_order], starts, axis=1)
        ring, phi = ring.ravel(), np.asarray(phi)
        values = np.empty(len(phi))
        for first in range(0, len(phi), CHUNK):
            here = slice(first, first + CHUNK)
            waves = azimuth_functions(phi[here], lmax)
            values[here] = (waves * orders[ring[here]]).sum(1)
        return values


def read_template(
    path: str | Path,
    frequency_mhz: float,
    lmax: int,
    *,
    file_frequency_mhz: float | None = None,
    spectral_index: float = -2.5,
    smoothing_deg: float = 0.0,
) -> HarmonicTemplate:
    """Read a template from a file: a sky, or ``posterior.nc`` of a map, whose mean it is.

    Parameters
    ----------
    path : str or Path
    frequency_mhz : float
        Of the template.
    lmax : int
        Highest ell of the file that is used.
    file_frequency_mhz : float, optional
        What the file was made for; by default what it says, or else ``frequency_mhz``. The sky is
        scaled by (frequency / file frequency)^spectral_index.
    spectral_index : float
    smoothing_deg : float
        Full width at half maximum of a Gaussian beam that the sky is seen through.

    Raises
    ------
    InputError
        If the file cannot be used, is too coarse, or is of another frequency than is said.
    """
    if formats.format_of(path) == formats.POSTERIOR:
        modes, read_at = _mean_of_posterior(path, lmax, file_frequency_mhz)
    else:
        read_at = frequency_mhz if file_frequency_mhz is None else file_frequency_mhz
        modes = read_sky_file(path).modes_at(read_at, lmax)
    ell, _ = mode_numbers(lmax)
    width = np.radians(smoothing_deg) / np.sqrt(8.0 * np.log(2.0))
    beam = np.exp(-0.5 * ell * (ell + 1.0) * width**2)
    return HarmonicTemplate(modes * beam * (frequency_mhz / read_at) ** spectral_index)


def _mean_of_posterior(
    path: str | Path, lmax: int, file_frequency_mhz: float | None
) -> tuple[Float[np.ndarray, " modes"], float]:
    """The mean up to an lmax, and its frequency in MHz."""
    found = read_netcdf(path, formats.POSTERIOR, POSTERIOR)
    mean, said = found.arrays["mean"], float(found.values["frequency_mhz"])
    if file_frequency_mhz is not None and not np.isclose(said, file_frequency_mhz, rtol=1e-9):
        raise InputError(
            f"{path} is of {said:g} MHz, file_frequency_mhz says {file_frequency_mhz:g}; leave it "
            "out"
        )
    if len(mean) < n_modes(lmax):
        raise InputError(
            f"{path} has coefficients up to ell = {lmax_of(len(mean))}, not up to {lmax}; lower "
            "lmax"
        )
    return mean[: n_modes(lmax)], said
