"""Interpolation between the directions and the frequencies of a file."""

from __future__ import annotations

from typing import Literal

import numpy as np
import scipy
from jaxtyping import Complex, Float

from lusee_bayes.core.errors import InputError
from lusee_bayes.instrument.beams.grid import HemisphereGrid

# between the frequencies of a file: luseepy's rule, straight lines between products of fields and
# between impedances, or cubic splines through fields and impedances
Interpolation = Literal["linear", "spline"]
# frequencies that differ by less are one, as in luseepy; a header holds 15 digits of them
SAME_FREQUENCY_MHZ = 1e-6


def neighbours(
    path: str, known_mhz: Float[np.ndarray, " frequencies"], frequency_mhz: float
) -> list[tuple[int, float]]:
    """Return the frequencies of a file that linear interpolation takes, and their weights.

    Parameters
    ----------
    path : str
        File that the frequencies come from, for the error message.
    known_mhz : (frequencies,) array
        Growing.
    frequency_mhz : float

    Returns
    -------
    list of (int, float)
        Place and weight: one of them where the file has the frequency, else two.

    Raises
    ------
    InputError
        Outside the known frequencies.
    """
    nearest = int(np.argmin(np.abs(known_mhz - frequency_mhz)))
    if abs(known_mhz[nearest] - frequency_mhz) <= SAME_FREQUENCY_MHZ:
        return [(nearest, 1.0)]
    if not known_mhz[0] < frequency_mhz < known_mhz[-1]:
        raise InputError(
            f"{path} has values from {known_mhz[0]:g} to {known_mhz[-1]:g} MHz, not at "
            f"{frequency_mhz:.12g}; change frequency_mhz, or give a file that reaches there"
        )
    above = int(np.searchsorted(known_mhz, frequency_mhz))
    low, high = known_mhz[above - 1], known_mhz[above]
    part = float((frequency_mhz - low) / (high - low))
    return [(above - 1, 1.0 - part), (above, part)]


def at_frequency(
    path: str,
    known_mhz: Float[np.ndarray, " frequencies"],
    frequency_mhz: float,
    *parts: np.ndarray,
    interpolation: Interpolation = "linear",
) -> list[np.ndarray]:
    """Interpolate arrays in frequency.

    Parameters
    ----------
    path : str
        File that the arrays come from, for the error message.
    known_mhz : (frequencies,) array
        Growing.
    frequency_mhz : float
    *parts : (frequencies, ...) array
    interpolation : {"linear", "spline"}

    Returns
    -------
    list of array
        The parts at ``frequency_mhz``, without their first axis; exactly those of the file where
        it has this frequency.

    Raises
    ------
    InputError
        Outside the known frequencies.
    """
    places = neighbours(path, known_mhz, frequency_mhz)
    if len(places) == 1:
        return [np.asarray(part[places[0][0]]) for part in parts]
    if interpolation == "linear":
        return [np.asarray(sum(weight * part[k] for k, weight in places)) for part in parts]
    degree = min(3, len(known_mhz) - 1)
    splines = [scipy.interpolate.make_interp_spline(known_mhz, part, k=degree) for part in parts]
    return [np.asarray(spline(frequency_mhz)) for spline in splines]


def on_grid(
    rows: Complex[np.ndarray, "theta phi"],
    theta: Float[np.ndarray, " theta"],
    grid: HemisphereGrid,
    angle_deg: float = 0.0,
) -> Complex[np.ndarray, "grid_theta grid_phi"]:
    """Interpolate a pattern to a grid: splines in theta, Fourier sums in phi.

    Parameters
    ----------
    rows : (theta, phi) array
        The pattern at azimuths 2 pi k / n.
    theta : (theta,) array
        Of the pattern, in radians.
    grid : HemisphereGrid
        Nothing is interpolated where its directions are those of the pattern.
    angle_deg : float
        How far to turn the pattern, from East towards North.

    Returns
    -------
    (grid_theta, grid_phi) array
    """
    same = len(grid.theta) == len(theta) and bool((grid.theta == theta).all())
    rows = rows if same else scipy.interpolate.CubicSpline(theta, rows)(grid.theta)
    n = rows.shape[1]
    steps = angle_deg * n / 360.0
    if grid.n_phi == n and steps == round(steps):
        return np.roll(rows, round(steps), axis=1)
    m = np.fft.fftfreq(n, 1.0 / n)
    spectrum = np.fft.fft(rows, axis=1) / n
    phi = grid.phi - np.radians(angle_deg)
    return spectrum @ np.exp(1j * m[:, None] * phi[None])
