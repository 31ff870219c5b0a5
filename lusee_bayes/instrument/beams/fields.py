"""Electric-field patterns of antennas: their response to a wave from every direction."""

from __future__ import annotations

import equinox as eqx
import numpy as np
from jaxtyping import Complex, Float

from lusee_bayes.core.arrays import Array, as_complex, namespace
from lusee_bayes.core.checks import Described, require_shape
from lusee_bayes.core.errors import InputError
from lusee_bayes.instrument.beams.grid import HemisphereGrid

SPEED_OF_LIGHT = 299792458.0  # m/s


def wavenumber(frequency_mhz: float | Float[Array, ""]) -> float | Float[Array, ""]:
    """Return k = 2 pi / wavelength, in 1/m."""
    return 2.0e6 * np.pi * frequency_mhz / SPEED_OF_LIGHT


def phasor(angle: Float[Array, "..."]) -> Complex[Array, "..."]:
    """Return exp(i angle)."""
    xp = namespace(angle)
    return as_complex(xp.cos(angle), xp.sin(angle))


class AntennaFields(Described, eqx.Module):
    """Complex response of each antenna to a wave arriving from each direction of a grid.

    Frame: topocentric, theta from the zenith, phi from East towards North. The time convention is
    exp(+i w t).

    Attributes
    ----------
    e_theta, e_phi : (antennas, theta, phi) complex array
        Response to the theta and phi components of the incident field, in one unit and with one
        phase centre for all antennas.
    grid : HemisphereGrid
    """

    e_theta: Complex[Array, "antennas theta phi"]
    e_phi: Complex[Array, "antennas theta phi"]
    grid: HemisphereGrid

    def __check_init__(self):
        expected = (None, len(self.grid.theta), self.grid.n_phi)
        require_shape("e_theta", self.e_theta, expected)
        require_shape("e_phi", self.e_phi, (self.e_theta.shape[0], *expected[1:]))
        for name in ("e_theta", "e_phi"):
            if getattr(self, name).dtype != np.complex128:
                raise InputError(
                    f"{name} must be a complex128 array, got {getattr(self, name).dtype}; "
                    "convert it with numpy.asarray(x, dtype=numpy.complex128)"
                )

    def description(self) -> tuple[str, ...]:
        return (
            f"E_theta and E_phi of {self.n_antennas} antennas, complex",
            f"{len(self.grid.theta)} angles from zenith to horizon x {self.grid.n_phi} azimuths, "
            "from East towards North",
        )

    @property
    def n_antennas(self) -> int:
        """Number of antennas."""
        return self.e_theta.shape[0]


def unit_vectors(grid: HemisphereGrid) -> Float[np.ndarray, "3 theta phi"]:
    """East, North and up components of every direction of the grid."""
    sin, cos = np.sin(grid.theta)[:, None], np.cos(grid.theta)[:, None]
    ones = np.ones((1, grid.n_phi))
    return np.stack([sin * np.cos(grid.phi), sin * np.sin(grid.phi), cos * ones])


def displaced(
    one: AntennaFields, positions_m: Float[np.ndarray, "antennas 3"], frequency_mhz: float
) -> AntennaFields:
    """Put identical copies of one antenna at several places; nothing couples them.

    E_i = E exp(i k n.r_i), so that V_ij is the interferometer's integral of
    B I exp(i k n.(r_i - r_j)).

    Parameters
    ----------
    one : AntennaFields
        Of one antenna.
    positions_m : (antennas, 3) array
        East, North, up, in metres.
    frequency_mhz : float

    Returns
    -------
    AntennaFields

    Raises
    ------
    InputError
        If ``one`` has more than one antenna.
    """
    if one.n_antennas != 1:
        raise InputError(f"give the pattern of one antenna, got {one.n_antennas}")
    require_shape("positions_m", positions_m, (None, 3))
    path = np.einsum("ac,ctp->atp", positions_m, unit_vectors(one.grid))
    phase = phasor(wavenumber(frequency_mhz) * path)
    return AntennaFields(one.e_theta * phase, one.e_phi * phase, one.grid)
