"""Beams from luseepy's files: the field pattern of one arm on a grid, put up four times.

FITS version 2: images Etheta_real, Etheta_imag, EPhi_real, EPhi_imag (frequency, theta, phi), the
response to a wave arriving from (theta, phi), phi from East towards North, time convention
exp(+i w t); gain_conv g(frequency), freq in MHz. Visibilities in K are

    T_ij = sqrt(g_i g_j) / (4 pi) int (Et_i conj(Et_j) + Ep_i conj(Ep_j)) I dOmega,

so that fields times sqrt(2 g / 4 pi) make product beams without any other normalisation.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from jaxtyping import Complex, Float
from scipy.interpolate import CubicSpline, make_interp_spline

from lusee_bayes.beams.fields import AntennaFields
from lusee_bayes.beams.grid import HemisphereGrid
from lusee_bayes.beams.product_beams import ProductBeams, product_beams
from lusee_bayes.checks import InputError, require_finite
from lusee_bayes.fits_images import read_images

FIELDS = ("Etheta_real", "Etheta_imag", "EPhi_real", "EPhi_imag")
# luseepy turns the pattern by 90 degrees from port to port: North, West, South, East for an arm
# that points North
ROTATIONS_DEG = (0.0, 90.0, 180.0, 270.0)
# luseepy's own horizon: 1 - (arctan((theta - pi / 2) / width) / pi + 1 / 2)^2
TAPER_WIDTH = 0.03


@dataclass(frozen=True)
class BeamFile:
    """The pattern of one arm at several frequencies.

    theta : from 0 to pi / 2; n_phi : azimuths 2 pi k / n_phi; gain : gain_conv; path : where it
    comes from, for messages
    """

    path: str
    frequencies_mhz: Float[np.ndarray, " frequencies"]
    theta: Float[np.ndarray, " theta"]
    e_theta: Complex[np.ndarray, "frequencies theta phi"]
    e_phi: Complex[np.ndarray, "frequencies theta phi"]
    gain: Float[np.ndarray, " frequencies"]

    @property
    def n_phi(self) -> int:
        """Number of azimuths."""
        return self.e_theta.shape[2]

    @property
    def rectangle_grid(self) -> HemisphereGrid:
        """The file's own directions with luseepy's rule: sin(theta) dtheta dphi."""
        return HemisphereGrid(self.theta, np.sin(self.theta) * self.theta[1], self.n_phi)

    def at(
        self, frequency_mhz: float
    ) -> tuple[Complex[np.ndarray, "theta phi"], Complex[np.ndarray, "theta phi"], float]:
        """Fields and gain at a frequency, between the file's by cubic splines.

        InputError outside the file's frequencies.
        """
        known = self.frequencies_mhz
        if not known[0] <= frequency_mhz <= known[-1]:
            raise InputError(
                f"{self.path} has beams from {known[0]:g} to {known[-1]:g} MHz, not at "
                f"{frequency_mhz:g}; change frequency_mhz, or give a file that reaches there"
            )
        parts = [self.e_theta, self.e_phi, self.gain]
        exact = np.flatnonzero(known == frequency_mhz)
        if len(exact):
            e_theta, e_phi, gain = (part[exact[0]] for part in parts)
        else:
            degree = min(3, len(known) - 1)
            splines = (make_interp_spline(known, part, k=degree) for part in parts)
            e_theta, e_phi, gain = (spline(frequency_mhz) for spline in splines)
        return e_theta, e_phi, float(gain)

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
        file's by splines in theta and Fourier sums in phi; ``rectangle_grid`` for what luseepy
        does. taper : fade out towards the horizon as luseepy does. rotations_deg : by how much the
        pattern is turned for each port, from East towards North. InputError as :meth:`at`.
        """
        *parts, gain = self.at(frequency_mhz)
        if grid is None:
            grid = HemisphereGrid.gauss_legendre(2 * len(self.theta), self.n_phi)
        scale = np.full(len(grid.theta), np.sqrt(2.0 * gain / (4.0 * np.pi)))
        if taper:
            below = np.arctan((grid.theta - np.pi / 2.0) / TAPER_WIDTH) / np.pi + 0.5
            scale = scale * (1.0 - below**2)
        turned = []
        for part in parts:
            same = len(grid.theta) == len(self.theta) and (grid.theta == self.theta).all()
            rows = part if same else CubicSpline(self.theta, part)(grid.theta)
            rows = rows * scale[:, None]
            turned.append(np.stack([_rotated(rows, a, grid.n_phi) for a in rotations_deg]))
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
        """Beams of all products up to ``lmax``; see :meth:`fields`."""
        fields = self.fields(frequency_mhz, grid=grid, taper=taper, rotations_deg=rotations_deg)
        return product_beams(fields, frequency_mhz, lmax, normalise=False)


def _rotated(
    rows: Complex[np.ndarray, "theta phi"], angle_deg: float, n_phi: int
) -> Complex[np.ndarray, "theta azimuths"]:
    """The pattern turned by an angle and on another number of azimuths, by its Fourier sum."""
    n = rows.shape[1]
    steps = angle_deg * n / 360.0
    if n_phi == n and steps == round(steps):
        return np.roll(rows, round(steps), axis=1)
    m = np.fft.fftfreq(n, 1.0 / n)
    spectrum = np.fft.fft(rows, axis=1) / n
    phi = 2.0 * np.pi * np.arange(n_phi) / n_phi - np.radians(angle_deg)
    return spectrum @ np.exp(1j * m[:, None] * phi[None])


def read_beam(path: str | Path) -> BeamFile:
    """Read a scalar beam file of luseepy, FITS version 2.

    InputError for a missing or truncated file, a missing image (named), shapes that do not fit,
    directions other than the hemisphere above the horizon, numbers that are not finite.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"no beam file at '{path}'; check beam.file")
    names = (*FIELDS, "gain_conv", "freq")
    found, header = read_images(path, names, "a scalar beam file of luseepy, FITS version 2")
    images = {name: image.astype(np.float64) for name, image in found.items()}
    fields = [images[name] for name in FIELDS]
    frequencies, gain = images["freq"], images["gain_conv"]
    shape = (len(frequencies), header.get("THETA_N"), header.get("PHI_N"))
    for name, image in zip(FIELDS, fields, strict=True):
        if image.shape != shape:
            raise InputError(
                f"{path}: {name} has shape {image.shape}, expected {shape} (frequencies, THETA_N, "
                "PHI_N)"
            )
    if gain.shape != frequencies.shape:
        raise InputError(f"{path}: gain_conv has {gain.size} values for {len(frequencies)} in freq")
    if not (np.diff(frequencies) > 0).all():
        raise InputError(f"{path}: the frequencies in freq do not grow")
    ends = [header.get(key) for key in ("THETA_MIN", "THETA_MAX", "PHI_MIN", "PHI_MAX")]
    if ends != [0.0, 90.0, 0.0, 360.0]:
        raise InputError(
            f"{path} covers theta {ends[0]} to {ends[1]} and phi {ends[2]} to {ends[3]} degrees; "
            "expected 0 to 90 and 0 to 360"
        )
    for name, values in [*zip(FIELDS, fields, strict=True), ("gain_conv", gain)]:
        require_finite(f"{path}: {name}", values)
    # the last azimuth is the first once more
    e_theta, e_phi = ((fields[k] + 1j * fields[k + 1])[:, :, :-1] for k in (0, 2))
    theta = np.linspace(0.0, np.pi / 2.0, shape[1])
    return BeamFile(str(path), frequencies, theta, e_theta, e_phi, gain)
