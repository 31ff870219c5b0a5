"""Fields given on directions and frequencies of a file, in between them."""

from __future__ import annotations

import numpy as np
from jaxtyping import Complex, Float
from scipy.interpolate import CubicSpline, make_interp_spline

from lusee_bayes.beams.grid import HemisphereGrid
from lusee_bayes.checks import InputError


def at_frequency(
    path: str,
    known_mhz: Float[np.ndarray, " frequencies"],
    frequency_mhz: float,
    *parts: np.ndarray,
) -> list[np.ndarray]:
    """Parts whose first axis is frequency, at one frequency, by cubic splines where it is between.

    ``path``: where they come from, for the message. InputError outside the known frequencies.
    """
    if not known_mhz[0] <= frequency_mhz <= known_mhz[-1]:
        raise InputError(
            f"{path} has beams from {known_mhz[0]:g} to {known_mhz[-1]:g} MHz, not at "
            f"{frequency_mhz:g}; change frequency_mhz, or give a file that reaches there"
        )
    exact = np.flatnonzero(known_mhz == frequency_mhz)
    if len(exact):
        return [np.asarray(part[exact[0]]) for part in parts]
    degree = min(3, len(known_mhz) - 1)
    splines = [make_interp_spline(known_mhz, part, k=degree) for part in parts]
    return [np.asarray(spline(frequency_mhz)) for spline in splines]


def on_grid(
    rows: Complex[np.ndarray, "theta phi"],
    theta: Float[np.ndarray, " theta"],
    grid: HemisphereGrid,
    angle_deg: float = 0.0,
) -> Complex[np.ndarray, "grid_theta grid_phi"]:
    """A pattern in between its samples, turned from East towards North.

    Splines in theta, Fourier sums in phi; neither where the grid's directions are the samples.
    """
    same = len(grid.theta) == len(theta) and bool((grid.theta == theta).all())
    rows = rows if same else CubicSpline(theta, rows)(grid.theta)
    n = rows.shape[1]
    steps = angle_deg * n / 360.0
    if grid.n_phi == n and steps == round(steps):
        return np.roll(rows, round(steps), axis=1)
    m = np.fft.fftfreq(n, 1.0 / n)
    spectrum = np.fft.fft(rows, axis=1) / n
    phi = grid.phi - np.radians(angle_deg)
    return spectrum @ np.exp(1j * m[:, None] * phi[None])
