"""The field pattern of one arm, used once for each port, from the scalar files of luseepy.

FITS version 2: images Etheta_real, Etheta_imag, EPhi_real, EPhi_imag (frequency, theta, phi), the
response to a wave arriving from (theta, phi), phi from East towards North, time convention
exp(+i w t); gain_conv g(frequency), freq in MHz, Z_real and Z_imag in Ohm. Visibilities in K are ::

    T_ij = sqrt(g_i g_j) / (4 pi) int (Et_i conj(Et_j) + Ep_i conj(Ep_j)) I dOmega,

so that fields times sqrt(2 g / 4 pi) give product beams without any other normalisation. Between
the frequencies of the file luseepy interpolates g and the integrals linearly, not the fields.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Complex, Float

from lusee_bayes.core.arrays import Array
from lusee_bayes.core.errors import InputError
from lusee_bayes.core.formats import read_fits
from lusee_bayes.core.layouts import Attribute, Layout, Variable
from lusee_bayes.instrument.beams.fields import AntennaFields
from lusee_bayes.instrument.beams.grid import HemisphereGrid
from lusee_bayes.instrument.beams.gridded import (
    Interpolation,
    at_frequency,
    neighbours,
    on_grid,
)
from lusee_bayes.instrument.beams.luseepy_rules import rectangle_rule
from lusee_bayes.instrument.beams.luseepy_words import CONVENTIONS, require_conventions
from lusee_bayes.instrument.beams.product_beams import ProductBeams, product_modes
from lusee_bayes.instrument.products import to_real

FIELDS = ("Etheta_real", "Etheta_imag", "EPhi_real", "EPhi_imag")
IMPEDANCE = ("Z_real", "Z_imag")
FIELD, OHM = Variable(("freq", "theta", "phi")), Variable(("freq",), optional=True, unit="Ohm")
LAYOUT = Layout(
    "a scalar beam file of luseepy, FITS version 2",
    {
        **dict.fromkeys(FIELDS, FIELD),
        "freq": Variable(("freq",), low=0.0, grows=True, unit="MHz"),
        "gain_conv": Variable(("freq",)),
        **dict.fromkeys(IMPEDANCE, OHM),
    },
    {
        **{key: Attribute("integer", low=2.0) for key in ("THETA_N", "PHI_N")},
        **{key: Attribute() for key in ("THETA_MIN", "THETA_MAX", "PHI_MIN", "PHI_MAX")},
        **dict.fromkeys(CONVENTIONS, Attribute("word", optional=True)),
    },
)
# luseepy turns the pattern by 90 degrees from port to port: North, West, South, East for an arm
# that points North
ROTATIONS_DEG = (0.0, 90.0, 180.0, 270.0)
# luseepy fades beams out by 1 - (arctan((theta - pi / 2) / width) / pi + 1 / 2)^2
TAPER_WIDTH = 0.03


@dataclass(frozen=True)
class ScalarBeam:
    """The pattern of one arm at several frequencies.

    Attributes
    ----------
    path : str
        The file, for error messages.
    frequencies_mhz : (frequencies,) array
    theta : (theta,) array
        From 0 to pi / 2 in equal steps; azimuths are 2 pi k / n_phi.
    e_theta, e_phi : (frequencies, theta, phi) complex array
        Fields in the unit of the file.
    gain : (frequencies,) array
        gain_conv of the file.
    impedance : (frequencies,) complex array or None
        Of the arm in Ohm; None where the file has none.
    interpolation : {"linear", "spline"}
        Between the frequencies: luseepy's rule, products of fields and gain linearly, or cubic
        splines through the fields and the gain.
    """

    path: str
    frequencies_mhz: Float[np.ndarray, " frequencies"]
    theta: Float[np.ndarray, " theta"]
    e_theta: Complex[np.ndarray, "frequencies theta phi"]
    e_phi: Complex[np.ndarray, "frequencies theta phi"]
    gain: Float[np.ndarray, " frequencies"]
    impedance: Complex[np.ndarray, " frequencies"] | None = None
    interpolation: Interpolation = "linear"

    @property
    def n_phi(self) -> int:
        """Number of azimuths."""
        return self.e_theta.shape[2]

    @property
    def luseepy_grid(self) -> HemisphereGrid:
        """The directions of the file with luseepy's rule: sin(theta) dtheta dphi."""
        return rectangle_rule(self.theta, self.n_phi)

    def fields(
        self,
        frequency_mhz: float,
        *,
        grid: HemisphereGrid | None = None,
        taper: bool = True,
        rotations_deg: tuple[float, ...] = ROTATIONS_DEG,
    ) -> AntennaFields:
        """Return the fields of the arms; their products are beams in K per K.

        Between the frequencies of the file this is so with splines only. With linear interpolation
        the fields themselves are interpolated here, for pictures; use :meth:`beams` for products.

        Parameters
        ----------
        frequency_mhz : float
        grid : HemisphereGrid, optional
            By default nodes that integrate across the horizon exactly; ``luseepy_grid`` is the
            rule of luseepy.
        taper : bool
            Fade out towards the horizon as luseepy does.
        rotations_deg : tuple of float
            How far the pattern is turned for each port, from East towards North.

        Returns
        -------
        AntennaFields
            In sqrt(1 / sr).

        Raises
        ------
        InputError
            Outside the frequencies of the file.
        """
        *parts, gain = self._at(frequency_mhz, self.e_theta, self.e_phi, self.gain)
        return self._put_up(parts, float(gain), grid, taper, rotations_deg)

    def beams(
        self,
        frequency_mhz: float,
        lmax: int,
        *,
        grid: HemisphereGrid | None = None,
        taper: bool = True,
        rotations_deg: tuple[float, ...] = ROTATIONS_DEG,
    ) -> ProductBeams:
        """Return the beams of all products, in K per K; arguments as of :meth:`fields`."""
        if self.interpolation == "spline":
            fields = self.fields(frequency_mhz, grid=grid, taper=taper, rotations_deg=rotations_deg)
            modes = product_modes(fields, lmax, normalise=False)
        else:
            (gain,) = self._at(frequency_mhz, self.gain)
            modes = np.zeros((len(rotations_deg) ** 2, (lmax + 1) ** 2))
            for k, weight in neighbours(self.path, self.frequencies_mhz, frequency_mhz):
                parts = [self.e_theta[k], self.e_phi[k]]
                fields = self._put_up(parts, float(gain), grid, taper, rotations_deg)
                modes += weight * product_modes(fields, lmax, normalise=False)
        return ProductBeams(modes, float(frequency_mhz))

    def impedance_at(self, frequency_mhz: float) -> complex | None:
        """Return the arm's impedance in Ohm, or None. InputError outside the file's frequencies."""
        if self.impedance is None:
            return None
        (ohm,) = self._at(frequency_mhz, self.impedance)
        return complex(ohm)

    def background(
        self,
        frequency_mhz: float,
        moon_k: float,
        *,
        grid: HemisphereGrid | None = None,
        taper: bool = True,
        rotations_deg: tuple[float, ...] = ROTATIONS_DEG,
    ) -> Float[Array, " products"]:
        """Return the visibilities without any sky: what ground of ``moon_k`` kelvin emits.

        An auto receives from the ground the part of its beam that the sky leaves. Arms in an
        enclosure of one temperature are taken to be uncorrelated, as they are where nothing
        couples them, so that a cross receives the part of the sky with the opposite sign.

        Parameters
        ----------
        frequency_mhz : float
        moon_k : float
            Temperature of the ground in K.
        grid, taper, rotations_deg
            As of :meth:`fields`.

        Returns
        -------
        (products,) array
            In K.

        Raises
        ------
        InputError
            Outside the frequencies of the file.
        """
        beams = self.beams(frequency_mhz, 0, grid=grid, taper=taper, rotations_deg=rotations_deg)
        sky = np.sqrt(4.0 * np.pi) * beams.modes[:, 0]
        return moon_k * (to_real(np.eye(len(rotations_deg), dtype=np.complex128)) - sky)

    def _at(self, frequency_mhz: float, *parts: np.ndarray) -> list[np.ndarray]:
        return at_frequency(
            self.path,
            self.frequencies_mhz,
            frequency_mhz,
            *parts,
            interpolation=self.interpolation,
        )

    def _put_up(
        self,
        parts: list[np.ndarray],
        gain: float,
        grid: HemisphereGrid | None,
        taper: bool,
        rotations_deg: tuple[float, ...],
    ) -> AntennaFields:
        """The fields of one arm, one for each port, with the scale that the gain gives them."""
        if grid is None:
            grid = HemisphereGrid.gauss_legendre(2 * len(self.theta), self.n_phi)
        scale = np.full(len(grid.theta), np.sqrt(2.0 * gain / (4.0 * np.pi)))
        if taper:
            below = np.arctan((grid.theta - np.pi / 2.0) / TAPER_WIDTH) / np.pi + 0.5
            scale = scale * (1.0 - below**2)
        turned = (
            np.stack([on_grid(part, self.theta, grid, a) for a in rotations_deg]) * scale[:, None]
            for part in parts
        )
        return AntennaFields(*(x.astype(np.complex128) for x in turned), grid)


def read_scalar_beam(path: str | Path) -> ScalarBeam:
    """Read a scalar beam file of luseepy, FITS version 2.

    Parameters
    ----------
    path : str or Path

    Returns
    -------
    ScalarBeam

    Raises
    ------
    InputError
        For a missing or truncated file, a missing image, shapes that do not fit, directions other
        than the hemisphere above the horizon, frequencies that do not grow, numbers that are
        not finite, or a header that states other conventions.
    """
    found = read_fits(path, LAYOUT, "check beam.file")
    images, said, sizes = found.arrays, found.values, found.sizes
    require_conventions(path, said)
    ends = [said[key] for key in ("THETA_MIN", "THETA_MAX", "PHI_MIN", "PHI_MAX")]
    if ends != [0.0, 90.0, 0.0, 360.0]:
        raise InputError(
            f"{path} covers theta {ends[0]:g} to {ends[1]:g} and phi {ends[2]:g} to {ends[3]:g} "
            "degrees; expected 0 to 90 and 0 to 360"
        )
    if (sizes["theta"], sizes["phi"]) != (said["THETA_N"], said["PHI_N"]):
        raise InputError(
            f"{path}: the fields have {sizes['theta']} x {sizes['phi']} directions, the header "
            f"says {said['THETA_N']} x {said['PHI_N']} (THETA_N, PHI_N)"
        )
    # the last azimuth is the first once more
    e_theta, e_phi = (
        (images[real] + 1j * images[imaginary])[:, :, :-1]
        for real, imaginary in (FIELDS[:2], FIELDS[2:])
    )
    theta = np.linspace(0.0, np.pi / 2.0, sizes["theta"])
    z = images["Z_real"] + 1j * images["Z_imag"] if set(IMPEDANCE) <= set(images) else None
    return ScalarBeam(str(path), images["freq"], theta, e_theta, e_phi, images["gain_conv"], z)
