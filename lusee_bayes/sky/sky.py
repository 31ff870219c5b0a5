"""A sky at one frequency, as real harmonic coefficients in Galactic coordinates."""

from __future__ import annotations

import equinox as eqx
import numpy as np
from jaxtyping import Float

from lusee_bayes.core.arrays import Array
from lusee_bayes.core.checks import Described, number, require_finite, require_float64
from lusee_bayes.core.harmonics import lmax_of, power_spectrum


class Sky(Described, eqx.Module):
    """Brightness temperature of the whole sky at one frequency.

    Attributes
    ----------
    modes : (modes,) array
        Real packed coefficients, Galactic, in K.
    frequency_mhz : float
        Frequency in MHz.
    name : str
        The sky's origin, such as the name of a file.

    Raises
    ------
    InputError
        If the coefficients are not float64, not finite, or do not fill an lmax.
    """

    modes: Float[Array, " modes"]
    frequency_mhz: float = eqx.field(static=True)
    name: str = eqx.field(static=True, default="sky")

    def __check_init__(self):
        require_float64("the sky", self.modes)
        require_finite("the sky", self.modes)
        lmax_of(self.modes.shape[-1])

    def description(self) -> tuple[str, ...]:
        mean = number(self.modes[0] / np.sqrt(4.0 * np.pi))
        return (
            f"{self.name} at {self.frequency_mhz:g} MHz, lmax = {self.lmax}",
            f"{self.modes.shape[-1]} real coefficients, Galactic, in K; mean {mean} K",
        )

    @property
    def lmax(self) -> int:
        """Highest ell of the coefficients."""
        return lmax_of(self.modes.shape[-1])

    @property
    def mean_temperature(self) -> float:
        """Sky average in K."""
        return float(self.modes[0]) / np.sqrt(4.0 * np.pi)

    def spectrum(self) -> Float[Array, " ells"]:
        """C_ell in K^2, mean not subtracted."""
        return power_spectrum(self.modes)
