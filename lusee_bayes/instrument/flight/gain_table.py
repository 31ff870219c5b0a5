"""Gains of the spectrometer: counts for a spectral density, by level, port and frequency.

As in luseepy's ``GainModel``: for each level (L, M, H) and port a mean gain and two components at
some frequencies, with strengths that are predicted by the telemetry, ::

    G(f) = mean(f) + q_1 v_1(f) + q_2 v_2(f),    q_r = sum_k c_rk phi_k,
    phi = 1, F, A, V, D, I, F^2, A^2, F A,

F the temperature of the FPGA, A that of the port's ADC (0 for ports 0 and 1, 1 for 2 and 3), V and
I voltage and current of its 1.8 V, D the 1.2 V. Between the frequencies all three go by cubic
splines; beyond them there is no gain. An auto in nV^2/Hz is counts / G, a cross is
counts / sqrt(G_a G_b).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float

from lusee_bayes.core.checks import require_positive, require_shape
from lusee_bayes.core.errors import InputError
from lusee_bayes.core.lazy import interpolate
from lusee_bayes.core.units import require_mhz
from lusee_bayes.instrument.flight.session import TELEMETRY
from lusee_bayes.instrument.flight.spectrometer import LEVELS, PORTS

LETTERS = tuple(LEVELS.values())
N_COMPONENTS, N_TERMS = 2, 9
# one nV^2/Hz
NANO2 = 1e-18


@dataclass(frozen=True, eq=False)
class GainTable:
    """Gains of all levels and ports.

    Attributes
    ----------
    path : str
        Where it comes from, for messages.
    anchor_mhz : (levels, ports, anchors) array
        Frequencies, growing.
    mean : (levels, ports, anchors) array
        Counts for 1 nV^2/Hz.
    component : (levels, ports, components, anchors) array
        v_r, in the same unit.
    coefficient : (levels, ports, components, terms) array
        c_rk, in the order of phi.
    component_std : (levels, ports, components) array or None
        By how much the strengths q_r may be off; None if it is not known.
    kind : str
        How it was read, for reports.
    """

    path: str
    anchor_mhz: Float[np.ndarray, "levels ports anchors"]
    mean: Float[np.ndarray, "levels ports anchors"]
    component: Float[np.ndarray, "levels ports components anchors"]
    coefficient: Float[np.ndarray, "levels ports components terms"]
    component_std: Float[np.ndarray, "levels ports components"] | None = None
    kind: str = "made"

    def __post_init__(self):
        lead = (len(LETTERS), PORTS)
        require_shape(f"{self.path}: mean", self.mean, (*lead, None))
        anchors = self.mean.shape[2]
        require_shape(f"{self.path}: anchor_mhz", self.anchor_mhz, (*lead, anchors))
        shape = (*lead, N_COMPONENTS, anchors)
        require_shape(f"{self.path}: component", self.component, shape)
        shape = (*lead, N_COMPONENTS, N_TERMS)
        require_shape(f"{self.path}: coefficient", self.coefficient, shape)
        if not (np.diff(self.anchor_mhz, axis=2) > 0.0).all():
            raise InputError(f"{self.path}: the frequencies of the gains do not grow")
        require_mhz(f"{self.path}: the frequencies of the gains", self.anchor_mhz)
        require_positive(f"{self.path}: the mean gain", self.mean, "give counts for 1 nV^2/Hz")

    @cached_property
    def _splines(self) -> dict[tuple[int, int], interpolate.CubicSpline]:
        return {
            (level, port): interpolate.CubicSpline(
                self.anchor_mhz[level, port],
                np.vstack([self.mean[level, port], self.component[level, port]]).T,
                extrapolate=False,
            )
            for level in range(len(LETTERS))
            for port in range(PORTS)
        }

    def basis(
        self, level: str, port: int, frequencies_mhz: Float[np.ndarray, " frequencies"]
    ) -> Float[np.ndarray, "3 frequencies"]:
        """Return mean, v_1 and v_2 at some frequencies.

        Parameters
        ----------
        level : {"L", "M", "H"}
        port : int
        frequencies_mhz : (frequencies,) array

        Returns
        -------
        (3, frequencies) array
            Counts for 1 nV^2/Hz; NaN where the table has no gain.
        """
        return self._splines[LETTERS.index(level), port](frequencies_mhz).T

    def strengths(
        self, level: str, port: int, telemetry: Mapping[str, Float[np.ndarray, " rows"]]
    ) -> Float[np.ndarray, "rows components"]:
        """Return q_1 and q_2 for telemetry.

        Parameters
        ----------
        level : {"L", "M", "H"}
        port : int
        telemetry : mapping of str to (rows,) array
            All of :data:`.TELEMETRY`.

        Raises
        ------
        InputError
            If something of it is missing.
        """
        phi = _features(port, telemetry)
        return phi @ self.coefficient[LETTERS.index(level), port].T


def _features(
    port: int, telemetry: Mapping[str, Float[np.ndarray, " rows"]]
) -> Float[np.ndarray, "rows terms"]:
    lacking = [name for name in TELEMETRY if name not in telemetry]
    if lacking:
        raise InputError(
            f"the telemetry lacks {', '.join(lacking)}, by which the gain table predicts gains; "
            "ingest the session with its telemetry, interpolated to the spectra"
        )
    fpga = telemetry["THERM_FPGA"]
    adc = telemetry["SPE_ADC0_T" if port < 2 else "SPE_ADC1_T"]
    v18, v12, i18 = (telemetry[name] for name in ("SPE_1VAD8_V", "VMON_1V2D", "SPE_1VAD8_C"))
    ones = np.ones_like(fpga)
    return np.stack([ones, fpga, adc, v18, v12, i18, fpga**2, adc**2, fpga * adc], axis=1)
