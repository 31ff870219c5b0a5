"""The brightest discrete sources of the low-frequency sky: positions and spectra.

Spectra are log-polynomials where they were measured. Below, no flux scale exists: the power law
of the last two octaves is carried on, through a turnover exp(-(nu/nu_t)^-2.1) by free-free
absorption on the way, ::

    S(nu) = S(nu_0) (nu/nu_0)^alpha exp(-(nu/nu_t)^-2.1 + (nu_0/nu_t)^-2.1),   nu < nu_0.

Expect 10 % at 50 MHz, 20 % at 20 MHz and no more than the order of magnitude below 10 MHz.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from lusee_bayes.core.errors import InputError
from lusee_bayes.core.harmonics import synthesis_matrix
from lusee_bayes.core.lazy import coordinates

BOLTZMANN = 1.380649e-23  # J/K
LIGHT_SPEED = 299792458.0  # m/s
JANSKY = 1e-26  # W / m^2 / Hz

# Optical depth of free-free absorption is close to nu^-2.1 (Mezger & Henderson 1967, ApJ 147, 471).
FREE_FREE_SLOPE = -2.1


@dataclass(frozen=True)
class PointSource:
    """A source small against LuSEE-Night's resolution (Cen A's lobes, 8 degrees long, least so).

    Attributes
    ----------
    name : str
        The source's name.
    ra_deg, dec_deg : float
        Position in degrees, ICRS (J2000).
    log_flux : tuple of float
        a_i in log10 S/Jy = sum_i a_i (log10 nu/GHz)^i.
    valid_from_mhz : float
        Lowest frequency of that polynomial, in MHz.
    turnover_mhz : float
        Frequency in MHz where the optical depth towards the source is one.
    """

    name: str
    ra_deg: float
    dec_deg: float
    log_flux: tuple[float, ...]
    valid_from_mhz: float
    turnover_mhz: float

    def _measured(self, frequency_mhz: float | np.ndarray) -> float | np.ndarray:
        x = np.log10(np.asarray(frequency_mhz, dtype=np.float64) / 1e3)
        return 10.0 ** np.polynomial.polynomial.polyval(x, self.log_flux)

    def _depth(self, frequency_mhz: float | np.ndarray) -> float | np.ndarray:
        return (np.asarray(frequency_mhz, dtype=np.float64) / self.turnover_mhz) ** FREE_FREE_SLOPE

    def flux_jy(self, frequency_mhz: float | np.ndarray) -> float | np.ndarray:
        """Compute the flux density in Jy.

        Parameters
        ----------
        frequency_mhz : float or array
            Frequencies in MHz.

        Raises
        ------
        InputError
            For frequencies that are not positive.
        """
        frequency = np.asarray(frequency_mhz, dtype=np.float64)
        if not np.all(frequency > 0.0):
            raise InputError(
                f"frequency_mhz is {frequency_mhz}, expected positive numbers; give it in MHz"
            )
        edge = self.valid_from_mhz
        # The mean slope of two octaves: the tangent of a quartic at its end is mostly noise.
        slope = math.log(self._measured(4.0 * edge) / self._measured(edge)) / math.log(4.0)
        below = np.minimum(frequency, edge)
        extrapolated = (below / edge) ** slope * np.exp(self._depth(edge) - self._depth(below))
        return self._measured(np.maximum(frequency, edge)) * extrapolated

    def galactic(self) -> tuple[float, float]:
        """Return Galactic longitude (0 to 360) and latitude in degrees."""
        at = coordinates.SkyCoord(self.ra_deg, self.dec_deg, unit="deg", frame="icrs").galactic
        return float(at.l.deg), float(at.b.deg)

    def kelvin_steradian(self, frequency_mhz: float | np.ndarray) -> float | np.ndarray:
        """Compute the brightness temperature integrated over the source, in K sr."""
        return kelvin_steradian(self.flux_jy(frequency_mhz), frequency_mhz)

    def modes(self, frequency_mhz: float, lmax: int) -> Float[np.ndarray, " modes"]:
        """Compute the source's coefficients: its K sr times the harmonics at its position.

        Parameters
        ----------
        frequency_mhz : float
            Frequency in MHz.
        lmax : int
            Highest ell.

        Returns
        -------
        (modes,) array
            Real packed coefficients, Galactic, in K.
        """
        l_deg, b_deg = self.galactic()
        theta, phi = np.array([np.radians(90.0 - b_deg)]), np.array([np.radians(l_deg)])
        return self.kelvin_steradian(frequency_mhz) * synthesis_matrix(theta, phi, lmax)[0]


def kelvin_steradian(
    flux_jy: float | np.ndarray, frequency_mhz: float | np.ndarray
) -> float | np.ndarray:
    """Convert flux densities to brightness temperature times solid angle, S c^2 / (2 k nu^2).

    Parameters
    ----------
    flux_jy : float or array
        Flux densities in Jy.
    frequency_mhz : float or array
        Frequencies in MHz.

    Returns
    -------
    float or array
        In K sr.
    """
    nu = np.asarray(frequency_mhz, dtype=np.float64) * 1e6
    return flux_jy * JANSKY * (LIGHT_SPEED / nu) ** 2 / (2.0 * BOLTZMANN)


def galactic_unit_vector(ra_deg: float, dec_deg: float) -> Float[np.ndarray, "3"]:
    """Return the Galactic unit vector of an ICRS (J2000) position in degrees."""
    position = coordinates.SkyCoord(ra_deg, dec_deg, unit="deg", frame="icrs").galactic
    return np.asarray(position.cartesian.xyz.value, dtype=np.float64)


# Positions: NED and SIMBAD. Polynomials and their lower ends: Perley & Butler 2017 (ApJS 230, 7),
# table 6, epoch 2016 for the two supernova remnants. Cen A: 2740 Jy at 408 MHz with its giant lobes
# (Cooper, Price & Cole 1965, Aust. J. Phys. 18, 589) and the one index, -0.70, that holds from 10
# to 4750 MHz (Alvarez et al. 2000, A&A 355, 863).
# Turnovers: Cyg A from 13.5 kJy at 10.05 MHz and Cas A from 28 kJy there in 1965 (Bridle 1967, in
# Baars et al. 1977, A&A 61, 99), 18.5 kJy in 2016 if fading by 0.8 % a year (Helmboldt & Kassim
# 2009, AJ 138, 838); the others from the column of electrons in :mod:`.free_free`, which
# for Tau A, 2 kpc away, is an upper limit.
BRIGHT_SOURCES = (
    PointSource("Cas A", 350.8500, 58.8150, (3.3584, -0.7518, -0.035, -0.071), 200.0, 11.9),
    PointSource("Cyg A", 299.8682, 40.7339, (3.3498, -1.0022, -0.225, 0.023, 0.043), 50.0, 12.7),
    PointSource("Vir A", 187.7059, 12.3911, (2.4466, -0.8116, -0.048), 50.0, 1.2),
    PointSource("Tau A", 83.6331, 22.0145, (2.9516, -0.2170, -0.047, -0.067), 50.0, 2.7),
    PointSource("Cen A", 201.3651, -43.0191, (3.4378 + 0.70 * math.log10(0.408), -0.70), 10.0, 2.3),
    PointSource("For A", 50.6738, -37.2082, (2.2180, -0.661), 200.0, 1.2),
    PointSource("Her A", 252.7839, 4.9926, (1.8298, -1.0247, -0.0951), 200.0, 1.9),
    PointSource("Hyd A", 139.5235, -12.0955, (1.7795, -0.9176, -0.084, -0.0139, 0.030), 50.0, 1.6),
    PointSource("Pic A", 79.9572, -45.7788, (1.9380, -0.7470, -0.074), 200.0, 1.3),
)
