"""How sessions are reduced."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from lusee_bayes.instrument.flight.clock import Clock
from lusee_bayes.instrument.flight.gain_table import GainTable
from lusee_bayes.instrument.flight.lines import NO_LINES, KnownLines
from lusee_bayes.instrument.flight.spectrometer import BinOrigin
from lusee_bayes.instrument.timestamps import Timestamp


@dataclass(frozen=True, eq=False)
class Recipe:
    """How sessions are reduced.

    Attributes
    ----------
    table : GainTable
    origin : {"centre", "edge"}
        What of channel k lies at k times 25 kHz.
    timestamp : {"start", "middle", "end", "instant"}
        What the times of spectra are.
    frequencies_mhz : tuple of float
        Middles of the bands.
    bandwidth_mhz : float
    degree : int
        Of the polynomial over a band (:mod:`.band`).
    average_s : float or None
        Length of averages in time; None for spectra as they are.
    shared_noise : tuple of float
        Of neighbouring channels (:func:`.shared_noise`).
    sign : {1, -1}
        Turns the imaginary parts of the spectrometer into those of <s_i conj(s_j)>.
    turntable_deg : float
        From East towards North.
    lines : KnownLines
    comb : {"found", "always", "never"}
        Whether the calibrator's comb is looked for, or known to be on or off.
    false_alarm : float
        Chance that a value of pure noise is flagged, for each kind of test.
    gain_std : float or None
        By how much every level of every port may be off, relative to its power gain, the same at
        all frequencies of a band; None if it is not known.
    clock : Clock or None
        From outside.
    site : (float, float) or None
        Longitude and latitude in degrees, in place of those of the files.
    """

    table: GainTable
    origin: BinOrigin
    timestamp: Timestamp
    frequencies_mhz: tuple[float, ...]
    bandwidth_mhz: float = 1.0
    degree: int = 2
    average_s: float | None = None
    shared_noise: tuple[float, ...] = (1.0,)
    sign: int = 1
    turntable_deg: float = 0.0
    lines: KnownLines = NO_LINES
    comb: Literal["found", "always", "never"] = "found"
    false_alarm: float = 1e-4
    gain_std: float | None = None
    clock: Clock | None = None
    site: tuple[float, float] | None = None

    def words(self) -> dict[str, str]:
        """Return how sessions are reduced, a line for each choice."""
        bin_part = {"centre": "centre", "edge": "lower edge"}[self.origin]
        times = "instants" if self.timestamp == "instant" else f"{self.timestamp} of integrations"
        return {
            "gain table": f"{Path(self.table.path).name} ({self.table.kind})",
            "frequencies": f"the {bin_part} of channel k is at k times 25 kHz",
            "bands": f"polynomial of degree {self.degree} over {self.bandwidth_mhz:g} MHz",
            "times": times,
            "site": "of the scenario" if self.site else "of the sessions",
        }
