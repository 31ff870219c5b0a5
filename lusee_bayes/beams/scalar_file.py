"""Scalar beams from luseepy's files: the field pattern of one arm on a grid, put up four times.

FITS version 2: images Etheta_real, Etheta_imag, EPhi_real, EPhi_imag (frequency, theta, phi), the
response to a wave arriving from (theta, phi), phi from East towards North, time convention
exp(+i w t); gain_conv g(frequency), freq in MHz, Z_real and Z_imag in Ohm. Visibilities in K are

    T_ij = sqrt(g_i g_j) / (4 pi) int (Et_i conj(Et_j) + Ep_i conj(Ep_j)) I dOmega,

so that fields times sqrt(2 g / 4 pi) make product beams without any other normalisation.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from lusee_bayes.beams.fields import AntennaFields
from lusee_bayes.beams.grid import HemisphereGrid
from lusee_bayes.beams.gridded import at_frequency, on_grid
from lusee_bayes.beams.luseepy_rules import rectangle_rule
from lusee_bayes.beams.product_beams import ProductBeams, product_beams, stokes_beam
from lusee_bayes.checks import InputError, require_finite
from lusee_bayes.fits_images import image_names, read_images
from lusee_bayes.products import to_real

FIELDS = ("Etheta_real", "Etheta_imag", "EPhi_real", "EPhi_imag")
IMPEDANCE = ("Z_real", "Z_imag")
# luseepy turns the pattern by 90 degrees from port to port: North, West, South, East for an arm
# that points North
ROTATIONS_DEG = (0.0, 90.0, 180.0, 270.0)
# luseepy's own horizon: 1 - (arctan((theta - pi / 2) / width) / pi + 1 / 2)^2
TAPER_WIDTH = 0.03


@dataclass(frozen=True)
class ScalarBeam:
    """The pattern of one arm at several frequencies.

    theta : from 0 to pi / 2, in equal steps; azimuths are 2 pi k / n_phi; gain : gain_conv;
    impedance : of the arm in Ohm, None where the file has none; path : for messages
    """

    path: str
    frequencies_mhz: Float[np.ndarray, " frequencies"]
    theta: Float[np.ndarray, " theta"]
    e_theta: Complex[np.ndarray, "frequencies theta phi"]
    e_phi: Complex[np.ndarray, "frequencies theta phi"]
    gain: Float[np.ndarray, " frequencies"]
    impedance: Complex[np.ndarray, " frequencies"] | None = None

    @property
    def n_phi(self) -> int:
        """Number of azimuths."""
        return self.e_theta.shape[2]

    @property
    def luseepy_grid(self) -> HemisphereGrid:
        """The file's own directions with luseepy's rule: sin(theta) dtheta dphi."""
        return rectangle_rule(self.theta, self.n_phi)

    def fields(
        self,
        frequency_mhz: float,
        *,
        grid: HemisphereGrid | None = None,
        taper: bool = True,
        rotations_deg: tuple[float, ...] = ROTATIONS_DEG,
    ) -> AntennaFields:
        """Fields of the arms in sqrt(1 / sr), such that their products are beams in K per K.

        grid : by default nodes that integrate across the horizon's cut exactly, in between the
        file's by splines in theta and Fourier sums in phi; ``luseepy_grid`` for what luseepy
        does. taper : fade out towards the horizon as luseepy does. rotations_deg : by how much the
        pattern is turned for each port, from East towards North. Between frequencies by cubic
        splines; InputError outside the file's.
        """
        *parts, gain = at_frequency(
            self.path, self.frequencies_mhz, frequency_mhz, self.e_theta, self.e_phi, self.gain
        )
        if grid is None:
            grid = HemisphereGrid.gauss_legendre(2 * len(self.theta), self.n_phi)
        scale = np.full(len(grid.theta), np.sqrt(2.0 * float(gain) / (4.0 * np.pi)))
        if taper:
            below = np.arctan((grid.theta - np.pi / 2.0) / TAPER_WIDTH) / np.pi + 0.5
            scale = scale * (1.0 - below**2)
        turned = (
            np.stack([on_grid(part, self.theta, grid, a) for a in rotations_deg]) * scale[:, None]
            for part in parts
        )
        return AntennaFields(*(jnp.asarray(x, dtype=jnp.complex128) for x in turned), grid)

    def beams(
        self,
        frequency_mhz: float,
        lmax: int,
        *,
        grid: HemisphereGrid | None = None,
        taper: bool = True,
        rotations_deg: tuple[float, ...] = ROTATIONS_DEG,
    ) -> ProductBeams:
        """Beams of all products up to ``lmax``, in K per K; see :meth:`fields`."""
        fields = self.fields(frequency_mhz, grid=grid, taper=taper, rotations_deg=rotations_deg)
        return product_beams(fields, frequency_mhz, lmax, normalise=False)

    def background(
        self,
        frequency_mhz: float,
        moon_k: float,
        *,
        grid: HemisphereGrid | None = None,
        taper: bool = True,
        rotations_deg: tuple[float, ...] = ROTATIONS_DEG,
    ) -> Float[Array, " products"]:
        """Visibilities without any sky, in K: ground of ``moon_k`` fills what the sky does not.

        An auto gets the fraction of the beam that ends on the ground. Arms in an enclosure of one
        temperature are taken to be uncorrelated, as they are where nothing couples them, so that a
        cross gets the sky's part with the opposite sign. The rest as in :meth:`fields`.
        """
        fields = self.fields(frequency_mhz, grid=grid, taper=taper, rotations_deg=rotations_deg)
        sky = fields.grid.integrate(to_real(stokes_beam(fields)))
        return moon_k * (to_real(jnp.eye(len(rotations_deg), dtype=jnp.complex128)) - sky)


def read_scalar_beam(path: str | Path) -> ScalarBeam:
    """Read a scalar beam file of luseepy, FITS version 2.

    InputError for a missing or truncated file, a missing image (named), shapes that do not fit,
    directions other than the hemisphere above the horizon, numbers that are not finite.
    """
    path = Path(path)
    known = image_names(path)
    impedance = IMPEDANCE if {name.lower() for name in IMPEDANCE} <= set(known) else ()
    names = (*FIELDS, "gain_conv", "freq", *impedance)
    found, header = read_images(path, names, "a scalar beam file of luseepy, FITS version 2")
    images = {name: image.astype(np.float64) for name, image in found.items()}
    fields = [images[name] for name in FIELDS]
    frequencies = images["freq"]
    shape = (len(frequencies), header.get("THETA_N"), header.get("PHI_N"))
    for name, image in zip(FIELDS, fields, strict=True):
        if image.shape != shape:
            raise InputError(
                f"{path}: {name} has shape {image.shape}, expected {shape} (frequencies, THETA_N, "
                "PHI_N)"
            )
    for name in ("gain_conv", *impedance):
        if images[name].shape != frequencies.shape:
            raise InputError(
                f"{path}: {name} has {images[name].size} values for {len(frequencies)} in freq"
            )
    require_growing(path, frequencies)
    ends = [header.get(key) for key in ("THETA_MIN", "THETA_MAX", "PHI_MIN", "PHI_MAX")]
    if ends != [0.0, 90.0, 0.0, 360.0]:
        raise InputError(
            f"{path} covers theta {ends[0]} to {ends[1]} and phi {ends[2]} to {ends[3]} degrees; "
            "expected 0 to 90 and 0 to 360"
        )
    for name, values in images.items():
        require_finite(f"{path}: {name}", values)
    # the last azimuth is the first once more
    e_theta, e_phi = ((fields[k] + 1j * fields[k + 1])[:, :, :-1] for k in (0, 2))
    theta = np.linspace(0.0, np.pi / 2.0, shape[1])
    z = images["Z_real"] + 1j * images["Z_imag"] if impedance else None
    return ScalarBeam(str(path), frequencies, theta, e_theta, e_phi, images["gain_conv"], z)


def require_growing(path: Path, frequencies: Float[np.ndarray, " frequencies"]) -> None:
    """InputError unless each frequency is above the one before."""
    if not (np.diff(frequencies) > 0).all():
        raise InputError(f"{path}: the frequencies in freq do not grow")
