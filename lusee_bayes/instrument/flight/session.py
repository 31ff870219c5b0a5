"""A session of the spectrometer: what is known of every spectrum; the spectra stay in the file."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Float32, Int, Shaped

from lusee_bayes.core.errors import InputError
from lusee_bayes.core.reading import reading
from lusee_bayes.core.representation import Described, counted
from lusee_bayes.instrument.flight.clock import Clock
from lusee_bayes.instrument.flight.spectrometer import (
    ADC_HIGH,
    ADC_LOW,
    AVERAGING,
    FRAME_S,
    N_CHANNELS,
)

# what the gain table asks of the telemetry
TELEMETRY = (
    "THERM_FPGA",
    "SPE_ADC0_T",
    "SPE_ADC1_T",
    "SPE_1VAD8_V",
    "VMON_1V2D",
    "SPE_1VAD8_C",
)
# counts of spectra [first:last] of all products and channels
Read = Callable[[int, int], Float32[np.ndarray, "rows products channels"]]


@dataclass(frozen=True, repr=False, eq=False)
class Session(Described):
    """A session; its spectra stay in the file.

    Attributes
    ----------
    path : Path
    layout : int
        Version of luseepy's layout.
    kind : str
        HDF5 or FITS.
    raw_s : (rows,) array
        The mission clock, in seconds.
    navgf : (rows,) array of int
        Averaging over channels (:data:`.AVERAGING`).
    navg_shift : (rows,) array of int
        Logarithm of the number of frames that a spectrum averages, to base 2.
    share : (rows,) array
        The share of them that was not rejected; 1 where the file does not say.
    level : (rows, ports) array of str
        Of the gain: L, M, H, or "-" where the gain table has none.
    adc_low, adc_high : (rows, ports) array of int
        Extremes of the ADC.
    adc_invalid : (rows, ports) array of int
        How many of its samples were out of range.
    errors : (rows,) array of int
        What the flight software says of itself.
    notch : (rows,) array of int or None
        Whether the average of every fourth channel is subtracted; None where the file does not say.
    telemetry : mapping of str to (rows,) array
        At the times of the spectra; some of :data:`TELEMETRY`.
    clock : Clock or None
        None if the file does not say which UTC the clock stands for.
    lon_deg, lat_deg : float
        Of the site, as the file has it.
    software : str
        Version of the flight software, as 0x307.
    opener : callable
        Opens the file: a context manager that gives a :data:`Read`.
    unused : mapping of str to int
        Other families of data in the file, and how many rows they have.
    """

    path: Path
    layout: int
    kind: str
    raw_s: Float[np.ndarray, " rows"]
    navgf: Int[np.ndarray, " rows"]
    navg_shift: Int[np.ndarray, " rows"]
    share: Float[np.ndarray, " rows"]
    level: Shaped[np.ndarray, "rows ports"]
    adc_low: Int[np.ndarray, "rows ports"]
    adc_high: Int[np.ndarray, "rows ports"]
    adc_invalid: Int[np.ndarray, "rows ports"]
    errors: Int[np.ndarray, " rows"]
    notch: Int[np.ndarray, " rows"] | None
    telemetry: Mapping[str, Float[np.ndarray, " rows"]]
    clock: Clock | None
    lon_deg: float
    lat_deg: float
    software: str
    opener: Callable[[], AbstractContextManager[Read]]
    unused: Mapping[str, int] = field(default_factory=dict)

    def __post_init__(self):
        back = np.flatnonzero(~(np.diff(self.raw_s) > 0.0))
        if back.size:
            k = int(back[0])
            raise InputError(
                f"{self.path}: spectrum {k + 1} (clock {self.raw_s[k + 1]:.6f} s) does not come "
                f"after spectrum {k} ({self.raw_s[k]:.6f} s); the spectra have to be in order"
            )
        for value in np.unique(self.navgf):
            if int(value) not in AVERAGING:
                known = ", ".join(map(str, AVERAGING))
                raise InputError(f"{self.path}: Navgf is {value}; the flight software has {known}")

    @property
    def n_rows(self) -> int:
        """Number of spectra."""
        return len(self.raw_s)

    @property
    def frames(self) -> Float[np.ndarray, " rows"]:
        """How many frames each spectrum averages."""
        return self.share * 2.0**self.navg_shift

    @property
    def window_s(self) -> Float[np.ndarray, " rows"]:
        """From the beginning to the end of each integration, in seconds."""
        return FRAME_S * 2.0**self.navg_shift

    @property
    def saturated(self) -> Bool[np.ndarray, " rows"]:
        """Whether an ADC was at the end of its range, or beyond."""
        # the flight software counts from -8191 or to 8192 in some versions
        ends = (self.adc_low <= ADC_LOW + 1) | (self.adc_high >= ADC_HIGH)
        return (ends | (self.adc_invalid > 0)).any(axis=1)

    @contextmanager
    def spectra(self) -> Iterator[Read]:
        """Open the file, for counts to be read piece by piece.

        Raises
        ------
        InputError
            For a file that is damaged, where it is.
        """
        with reading(self.path, "a session"), self.opener() as read:
            yield read

    def description(self) -> tuple[str, ...]:
        states = ["".join(row) for row in np.unique(self.level, axis=0)]
        clock = "its clock stands for a UTC that the file does not say"
        if self.clock is not None:
            ends = self.clock.utc(self.raw_s[[0, -1]])
            clock = f"{ends[0].isot[:19]} to {ends[1].isot[:19]} UTC, clock in {self.clock.scale}"
        averaged = ", ".join(map(str, np.unique(self.navgf)))
        window = self.window_s
        length = f"{window.min():.6g}" + (
            "" if np.ptp(window) == 0.0 else f" to {window.max():.6g}"
        )
        notch = "not said" if self.notch is None else f"{int((self.notch > 0).sum())} with it"
        lacking = [name for name in TELEMETRY if name not in self.telemetry]
        unused = [f"{name} ({counted(n, 'row')})" for name, n in self.unused.items()]
        return (
            f"{self.n_rows} spectra of 16 products, {N_CHANNELS} channels, {self.kind} layout "
            f"{self.layout}, flight software {self.software}",
            clock,
            f"each integrated for {length} s; Navgf {averaged}; gains of the ports "
            f"{', '.join(states)}",
            f"site: longitude {self.lon_deg:g}, latitude {self.lat_deg:g} degrees",
            f"{int(self.saturated.sum())} spectra with a saturated ADC, "
            f"{int((self.errors != 0).sum())} with errors of the flight software, "
            f"{int((self.share < 1.0).sum())} partly averaged; notch: {notch}",
            "telemetry of the gain table: " + ("lacks " + ", ".join(lacking) if lacking else "all"),
            *(["not used: " + ", ".join(unused)] if unused else []),
        )
