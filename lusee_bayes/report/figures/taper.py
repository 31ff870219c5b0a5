"""The beam through which maps are drawn, so that bright edges have no rings.

Coefficients that end abruptly at lmax ring: beside the Galactic plane a truth of lmax = 47 falls
to half of the real sky, and one of lmax = 24 below zero. A Gaussian beam with a tenth left at lmax
takes the rings to the per cent level. It is for the eye only: files and numbers are without it.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from lusee_bayes.core.harmonics import lmax_of, modes_to_map, per_mode

LEFT_AT_LMAX = 0.1


def taper(lmax: int) -> Float[np.ndarray, " ells"]:
    """Return the beam's factor at ell = 0..lmax: exp(-ell (ell + 1) sigma^2 / 2)."""
    ell = np.arange(lmax + 1)
    return LEFT_AT_LMAX ** (ell * (ell + 1.0) / max(lmax * (lmax + 1.0), 1.0))


def taper_fwhm_deg(lmax: int) -> float:
    """Return the beam's full width at half maximum in degrees; ``lmax`` is at least 1."""
    sigma = np.sqrt(-2.0 * np.log(LEFT_AT_LMAX) / (lmax * (lmax + 1.0)))
    return float(np.degrees(sigma * np.sqrt(8.0 * np.log(2.0))))


def shown(modes: Float[np.ndarray, " modes"], nside: int) -> Float[np.ndarray, " pixels"]:
    """Synthesise the HEALPix RING map of packed coefficients, seen through the beam."""
    return modes_to_map(modes * per_mode(taper(lmax_of(len(modes)))), nside)
