"""What a session says of each of its spectra, as it is to be written."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int, Shaped

from lusee_bayes.instrument.flight.clock import DAY_S, Clock
from lusee_bayes.instrument.flight.session_layout import MJD_ZERO, UNKNOWN
from lusee_bayes.instrument.flight.spectrometer import LEVELS, PORTS

# of the frames, so many are averaged by the hardware, as a power of two; software does the rest
NAVG1_SHIFT = 14
CODES = {level: code for code, level in LEVELS.items()}
# the offset between two samples of an ADC that have no signal
ADC_MEAN = 0.3


@dataclass(frozen=True, eq=False)
class SessionRows:
    """A session without its spectra.

    Attributes
    ----------
    raw_s : (rows,) array
        The mission clock, in seconds.
    navgf : (rows,) array of int
        Averaging over channels (:data:`.AVERAGING`).
    navg_shift : (rows,) array of int
        Logarithm of the number of frames that a spectrum averages, to base 2.
    level : (rows, ports) array of str
        Of the gain: L, M, H.
    bitslice : (rows, 16) array of int
        Counts are multiples of 2^(bitslice - 31).
    adc_low, adc_high, adc_invalid : (rows, ports) array of int
        Extremes of the ADC, and how many of its samples were out of range.
    adc_rms : (rows, ports) array
    telemetry : mapping of str to (rows,) array
        At the times of the spectra.
    clock : Clock or None
        None for a file that is not to say which UTC the clock stands for.
    lon_deg, lat_deg : float
        Of the site.
    software : int
        Version of the flight software.
    """

    raw_s: Float[np.ndarray, " rows"]
    navgf: Int[np.ndarray, " rows"]
    navg_shift: Int[np.ndarray, " rows"]
    level: Shaped[np.ndarray, "rows ports"]
    bitslice: Int[np.ndarray, "rows products"]
    adc_low: Int[np.ndarray, "rows ports"]
    adc_high: Int[np.ndarray, "rows ports"]
    adc_invalid: Int[np.ndarray, "rows ports"]
    adc_rms: Float[np.ndarray, "rows ports"]
    telemetry: Mapping[str, Float[np.ndarray, " rows"]]
    clock: Clock | None
    lon_deg: float
    lat_deg: float
    software: int

    @property
    def n_rows(self) -> int:
        """Number of spectra."""
        return len(self.raw_s)

    def metadata(self) -> dict[str, np.ndarray]:
        """Return the fields of every spectrum, by the names of layout 3."""
        first = np.minimum(self.navg_shift, NAVG1_SHIFT)
        gain = np.vectorize(CODES.__getitem__, otypes=[np.int64])(self.level)
        none = np.zeros(self.n_rows, dtype=np.int64)
        return {
            "Navg1_shift": first,
            "Navg2_shift": self.navg_shift - first,
            "Navgf": self.navgf,
            "format": none,
            "errors": none,
            "actual_bitslice": self.bitslice,
            "bitslice": self.bitslice,
            "actual_gain": gain,
            "gain": gain,
            "adc_min": self.adc_low,
            "adc_max": self.adc_high,
            "adc_mean": np.full((self.n_rows, PORTS), ADC_MEAN),
            "adc_rms": self.adc_rms,
            "adc_invalid_count_min": self.adc_invalid,
            "adc_invalid_count_max": np.zeros_like(self.adc_invalid),
        }

    def clock_words(self) -> tuple[float, float, str, str]:
        """Return how layout 3 says the clock.

        Returns
        -------
        raw_s, mjd : float
            A reading, and the MJD that it stands for; zero where that is not known.
        scale, source : str
        """
        if self.clock is None:
            return 0.0, 0.0, UNKNOWN, UNKNOWN
        mjd = (self.clock.jd1 - MJD_ZERO) + self.clock.jd2
        return self.clock.raw_s, mjd, self.clock.scale, "mission_counter"

    def mjd(self) -> Float[np.ndarray, " rows"]:
        """Return the column of MJD that luseepy computes of the clock."""
        raw_s, mjd, _, _ = self.clock_words()
        return (self.raw_s - raw_s) / DAY_S + mjd
