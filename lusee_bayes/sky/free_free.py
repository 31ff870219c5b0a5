"""Free-free absorption and emission of the warm ionised gas of the Galaxy.

The absorption coefficient at frequency nu is k(nu) <n_e^2>. <n_e^2> follows NE2001 (Cordes &
Lazio 2002, astro-ph/0207156), reduced to what a degree-scale sky below 50 MHz shows: the thick
disc, the annular thin disc, the low-density regions around the Sun, and the one nearby HII shell
that is opaque at 10 MHz. Its spiral arms are left out: the sky agrees with ULSA without them.

Positions are in kpc, Galactocentric, NE2001's axes: x towards l = 90 degrees, y from the centre
towards the Sun, z towards the north Galactic pole; the Sun is at (0, 8.5, 0).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

ELECTRON_TEMPERATURE_K = 8000.0
SUN_RADIUS_KPC = 8.5

# Densities, heights and radii are NE2001's (n1h1/h1, h1, A1; n2, h2, A2). The clumping factor
# <n^2>/<n>^2 of the thick disc is tuned by hand against ULSA's mean at 1 MHz; it is that of gas
# filling 30 % of the volume (Gaensler et al. 2008, PASA 25, 184, find 4 to 30 %). That of the thin
# disc is NE2001's F2; F1 = 0.18, made for scattering, would leave 1 MHz four times too bright.
THICK_DENSITY_CM3 = 0.034
THICK_HEIGHT_KPC = 0.97
THICK_EDGE_KPC = 17.5
THICK_CLUMPING = 3.5
THIN_DENSITY_CM3 = 0.08
THIN_HEIGHT_KPC = 0.15
THIN_RADIUS_KPC = 3.8
THIN_WIDTH_KPC = 1.8
THIN_CLUMPING = 120.0


def absorption_per_emission_measure(frequency_mhz: float) -> float:
    """Compute the optical depth of one unit of emission measure, int <n_e^2> ds = 1 pc cm^-6.

    tau = 3.014e-2 T^-1.5 nu^-2 EM g with g = ln(4.955e-2 / nu) + 1.5 ln T, nu in GHz, T in K.
    g carries the Gaunt factor; the usual nu^-2.1 law is its slope near 1 GHz, and 20 % too high
    at 1 MHz.

    Parameters
    ----------
    frequency_mhz : float
        Frequency in MHz.

    References
    ----------
    Oster 1961, Rev. Mod. Phys. 33, 525; Wilson, Rohlfs & Huettemeister, Tools of Radio
    Astronomy, eq. 10.35.
    """
    nu_ghz = frequency_mhz / 1e3
    gaunt = np.log(4.955e-2 / nu_ghz) + 1.5 * np.log(ELECTRON_TEMPERATURE_K)
    return float(3.014e-2 * ELECTRON_TEMPERATURE_K**-1.5 * nu_ghz**-2 * gaunt)


def thermal_emission(depth: np.ndarray) -> np.ndarray:
    """Compute the brightness temperature of the gas itself, T_e (1 - exp(-tau)), in K.

    The gas has one temperature. So the emission of all its parts, each absorbed by the gas in
    front of it, int T_e exp(-tau) dtau, depends on the whole optical depth only: what is
    transparent adds T_e tau, what is opaque is a black body of T_e.

    Parameters
    ----------
    depth : array
        Optical depth of the whole line of sight.

    References
    ----------
    Rybicki & Lightman, Radiative Processes in Astrophysics, eq. 1.30 (Rayleigh-Jeans).
    """
    return -ELECTRON_TEMPERATURE_K * np.expm1(-depth)


def thick_disc(radius_kpc: np.ndarray) -> np.ndarray:
    """Compute the thick disc's mid-plane <n_e^2> in cm^-6 at Galactocentric radii in kpc."""
    edge = 0.5 * np.pi / THICK_EDGE_KPC
    shape = np.cos(edge * np.minimum(radius_kpc, THICK_EDGE_KPC)) / np.cos(edge * SUN_RADIUS_KPC)
    return THICK_CLUMPING * (THICK_DENSITY_CM3 * shape) ** 2


def thin_disc(radius_kpc: np.ndarray) -> np.ndarray:
    """Compute the annular thin disc's mid-plane <n_e^2> in cm^-6 at cylindrical radii in kpc."""
    shape = np.exp(-2.0 * ((radius_kpc - THIN_RADIUS_KPC) / THIN_WIDTH_KPC) ** 2)
    return THIN_CLUMPING * THIN_DENSITY_CM3**2 * shape


def height_profile(z_kpc: np.ndarray, height_kpc: float) -> np.ndarray:
    """Compute <n_e^2> at heights in kpc over its mid-plane value: NE2001's sech^2, squared."""
    return np.cosh(np.minimum(np.abs(z_kpc) / height_kpc, 100.0)) ** -4.0


@dataclass(frozen=True)
class Region:
    """An ellipsoid of uniform <n_e^2> that replaces the discs inside it.

    Attributes
    ----------
    name : str
        The region's name.
    centre_kpc : tuple of float
        Its centre, Galactocentric.
    semi_axes_kpc : tuple of float
        Along the major axis, across it in the plane, and vertical.
    angle_deg : float
        Of the major axis from +x towards +y.
    n_squared_cm6 : float
        <n_e^2> in cm^-6.
    """

    name: str
    centre_kpc: tuple[float, float, float]
    semi_axes_kpc: tuple[float, float, float]
    angle_deg: float
    n_squared_cm6: float

    def chord(self, direction: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Find where lines of sight enter and leave the ellipsoid.

        Parameters
        ----------
        direction : (..., 3) array
            Unit vectors.

        Returns
        -------
        enter, leave : (...) arrays
            Distances from the Sun in kpc; both are equal where the line misses the ellipsoid.
        """
        c, s = np.cos(np.radians(self.angle_deg)), np.sin(np.radians(self.angle_deg))
        to_ball = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
        to_ball = to_ball / np.array(self.semi_axes_kpc)[:, None]
        u = direction @ to_ball.T
        w = to_ball @ (np.array([0.0, SUN_RADIUS_KPC, 0.0]) - np.array(self.centre_kpc))
        uu = np.sum(u * u, axis=-1)
        middle = -(u @ w) / uu
        half = np.sqrt(np.maximum(middle**2 - (w @ w - 1.0) / uu, 0.0))
        return np.maximum(middle - half, 0.0), np.maximum(middle + half, 0.0)


# NE2001's local interstellar medium and one of its clumps, <n^2> = F n^2 with its n and F. Where
# two overlap the first one listed counts, as in NE2001; its local hot bubble, a slanted cylinder,
# and its Loop I, a half sphere, are upright ellipsoids here. The Vela shell lies at l = 263.25,
# b = -9, 0.25 kpc away, and is opaque at 10 MHz: it makes much of ULSA's odd multipoles there.
REGIONS = (
    Region("IRAS Vela shell", (-0.2452, 8.5290, -0.0391), (0.038,) * 3, 0.0, 4.0**2 * 3.0),
    Region("local hot bubble", (0.01, 8.45, 0.17), (0.085, 0.10, 0.33), 0.0, 0.005**2 * 0.01),
    Region("Loop I", (-0.045, 8.40, 0.07), (0.18, 0.18, 0.18), 0.0, 0.0125**2 * 0.2),
    Region("local superbubble", (-0.75, 9.0, -0.05), (1.05, 0.425, 0.325), 139.0, 0.016**2 * 0.01),
    Region("low-density region", (1.36, 8.06, 0.0), (1.50, 0.75, 0.50), -24.2, 0.012**2 * 0.10),
)
