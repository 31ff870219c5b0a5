"""A power spectrum with parameters: amplitude, tilt, curvature, and departures at half octaves.

::

    ln C_ell = a + tilt x + curvature x^2 / 2 + sum_k d_k hat_k(x),    x = ln((ell + 1) / 10)
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

# ell + 1 at which the amplitude is that of the spectrum
PIVOT = 10.0
# distance in ln(ell + 1) of the knots of departures
SPACING = 0.5 * np.log(2.0)

# Diffuse Galactic emission falls as ell^-2.4 to ell^-3.1 (La Porta et al. 2008, A&A 479, 641), with
# little curvature. The hyperprior's tails leave room for skies that are unlike it.
TILT, TILT_WIDTH = -2.7, 0.2
CURVATURE_WIDTH = 0.3
DEPARTURE_WIDTH = 0.15
# standard deviation of ln C at the pivot: hardly anything is known
LOG_AMPLITUDE_WIDTH = 6.0


@dataclass(frozen=True)
class SpectrumBasis:
    """ln C_ell as a linear function of its parameters.

    Attributes
    ----------
    matrix : (ells, parameters) array
    centre, width : (parameters,) array
        What is expected of the parameters.
    """

    matrix: Float[np.ndarray, "ells parameters"]
    centre: Float[np.ndarray, " parameters"]
    width: Float[np.ndarray, " parameters"]

    # of the parameters that are reported
    names = ("ln C at ell = 9", "tilt", "curvature")

    @classmethod
    def around(cls, power: float, lmax: int) -> SpectrumBasis:
        """Make the basis.

        Parameters
        ----------
        power : float
            Expected C_ell at the pivot, in K^2.
        lmax : int
        """
        x = np.log((np.arange(lmax + 1) + 1.0) / PIVOT)
        knots = np.arange(x[min(1, lmax)], x[-1] + SPACING, SPACING)
        hats = np.maximum(0.0, 1.0 - np.abs(x[:, None] - knots) / SPACING)
        matrix = np.column_stack([np.ones(lmax + 1), x, 0.5 * x**2, hats])
        departures = np.full(len(knots), DEPARTURE_WIDTH)
        return cls(
            matrix,
            np.concatenate([[np.log(power), TILT, 0.0], np.zeros(len(knots))]),
            np.concatenate([[LOG_AMPLITUDE_WIDTH, TILT_WIDTH, CURVATURE_WIDTH], departures]),
        )
