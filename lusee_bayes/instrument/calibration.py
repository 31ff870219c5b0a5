"""What is left of a spectrometer's spectra in their averages: how many samples, and which gains.

An average over channels and spectra has the radiometer noise of the independent samples of the
voltages that it is the mean of; its gain is off by the errors of the gain table, which all spectra
of one level of one port share.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from lusee_bayes.core.checks import require_finite, require_positive, require_shape
from lusee_bayes.core.errors import InputError


@dataclass(frozen=True)
class Calibration:
    """Samples behind every time, and what is not known about its gains.

    Attributes
    ----------
    n_averaged : (times,) array
        Independent samples of complex voltages behind every time: bandwidth times live time, less
        what unequal weights and overlapping channels cost.
    gain_names : tuple of str
        Errors of the gain table, such as "M0 PC1": level, port and component.
    gain_port : (errors,) array of int
        The port of each.
    gain_slope : (errors, times) array
        By how much a port's power gain is above the table's, relative to it, where the error is
        one prior standard deviation; 0 at times when the port has another level.
    lost : float
        Share of the spectra that rules of the reduction flagged.

    Raises
    ------
    InputError
        If lengths do not fit, or something is not finite or positive.
    """

    n_averaged: Float[np.ndarray, " times"]
    gain_names: tuple[str, ...] = ()
    gain_port: Int[np.ndarray, " errors"] | None = None
    gain_slope: Float[np.ndarray, "errors times"] | None = None
    lost: float = 0.0

    def __post_init__(self):
        require_positive("the number of samples averaged", self.n_averaged)
        n, times = len(self.gain_names), len(self.n_averaged)
        if (self.gain_port is None) != (n == 0) or (self.gain_slope is None) != (n == 0):
            raise InputError("errors of the gain table need names, ports and slopes")
        if n:
            require_shape("gain_port", self.gain_port, (n,))
            require_shape("gain_slope", self.gain_slope, (n, times))
            require_finite("gain_slope", self.gain_slope)

    def select(self, keep: Bool[np.ndarray, " times"]) -> Calibration:
        """Return that of the times where ``keep`` is True."""
        slope = None if self.gain_slope is None else self.gain_slope[:, keep]
        return Calibration(self.n_averaged[keep], self.gain_names, self.gain_port, slope, self.lost)
