"""How sessions are reduced or simulated, and all their spectra in order of time.

The section ``flight`` of a scenario is defined here; a recipe is this section with its files read.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from astropy.time import Time
from jaxtyping import Int
from pydantic import Field

from lusee_bayes.core import arrays, reading
from lusee_bayes.core.errors import InputError
from lusee_bayes.core.section import LARGEST, Angle, Frequency, Positive, Section, requires
from lusee_bayes.flight.bands import Taper
from lusee_bayes.flight.clock import Clock, clock_of
from lusee_bayes.flight.gain_model import GainModel
from lusee_bayes.flight.session import BinOrigin, Session
from lusee_bayes.instrument import averaging, products
from lusee_bayes.instrument.observation import Observation
from lusee_bayes.instrument.times import TO_MIDDLE, Timestamp, contiguous, later, utc_of, utc_times

Share = Annotated[float, Field(ge=0, le=0.5)]
Levels = Annotated[str, Field(pattern="^[LMH]{4}$")]


class FlightSimulatedSection(Section):
    """Sessions written by ``simulate --flight``; by default without disturbances.

    Attributes
    ----------
    kind : {"hdf5", "fits"}
        File format.
    navgf : {1, 2, 3, 4}
        Averaging over channels (Navgf).
    levels : str
        Gain levels of the four ports, each L, M or H.
    session_h : float
        Session length.
    clock : {"known", "unknown"}
        Whether the files relate their clock to UTC; if not, a separate clock file does.
    radiometer : bool
        Add radiometer noise to every channel.
    switch_h : float
        Time from the start of the observation at which gains change to ``switch_levels``.
    switch_levels : str
        Gain levels after that change.
    absent_share : float
        Fraction of spectra that lack one product.
    saturated_share : float
        Fraction of spectra with saturated ADCs.
    tones_mhz : tuple of float
        Frequencies of tones, each confined to one channel.
    tone_share : float
        Fraction of spectra that contain the tones.
    tone_factor : float
        Power of a tone, in units of the radiometer noise of a channel.
    comb_share : float
        Fraction of spectra with the calibrator's comb on.
    comb_factor : float
        Power of each comb line, in units of the radiometer noise of a channel.
    burst_every_h : float
        Mean time between bursts, such as those of Jupiter and the Sun.
    burst_s : float
        Duration of the longest burst; the shortest last one spectrum.
    burst_factor : float
        Power of a burst, in units of the radiometer noise of a spectrum in 1 MHz.
    """

    kind: Literal["hdf5", "fits"] = "hdf5"
    navgf: Literal[1, 2, 3, 4] = 1
    levels: Levels = "MMMM"
    session_h: Positive = 24.0
    clock: Literal["known", "unknown"] = "known"
    radiometer: bool = True
    switch_h: Positive | None = None
    switch_levels: Levels = "LLLL"
    absent_share: Share = 0.0
    saturated_share: Share = 0.0
    tones_mhz: Annotated[tuple[Frequency, ...], Field(max_length=100)] = ()
    tone_share: Share = 0.1
    tone_factor: Positive = 30.0
    comb_share: Share = 0.0
    comb_factor: Positive = 3.0
    # sampling a month with a burst every 4 s takes 10 s
    burst_every_h: Annotated[float, Field(ge=1e-3, le=LARGEST)] | None = None
    burst_s: Positive = 600.0
    burst_factor: Positive = 30.0


# probabilities of a false alarm
Rare = Annotated[float, Field(ge=1e-12, le=0.1)]


class FlightSection(Section):
    """Reduction of spectrometer sessions to visibilities, for --data that are sessions.

    Attributes
    ----------
    gain_table : str
        Folder of luseepy's gain model, or a netCDF gain table.
    gain_model : {"quadratic", "linear"}
        Coefficients to use from luseepy's folder.
    component_std : tuple of float
        Standard deviations of the strengths of the two gain components, independent for each level
        of each port; used if the gain table lacks them.
    gain_std : float
        Additional relative standard deviation of the power gain, for each level of each port; for
        each port, if ``noise.gain_table`` simulates data other than sessions.
    bin_origin : {"centre", "edge"}
        Point of channel k that lies at k times 25 kHz. The convention is not settled: set this key.
    clock : str
        Clock reference (JSON), for files with no absolute time, or to correct the UTC in the
        files.
    site : {"file", "scenario"}
        Where to read the site; luseepy files contain a placeholder if none was configured.
    bandwidth_hz : float
        Width of the band around the frequency of a map.
    degree : int
        Degree of the polynomial fitted to the spectrum in the band and evaluated at its middle.
    filter_taps : int
        Taps of the filter bank, which set how much noise neighbouring channels share; 0 for none.
    filter_window : {"rectangular", "hann", "hamming", "blackman"}
        Window of the filter bank.
    convention : {"s_i conj(s_j)", "conj(s_i) s_j"}
        Quantity whose mean is a complex product.
    per_kelvin_v2_hz : float
        V^2/Hz that 1 K produces at each port, for beams not calibrated in volts.
    turntable_deg : float
        Turntable angle, from East towards North.
    turns : dict of str to float
        Later turntable angles in degrees, each by the UTC from which it holds, such as
        ``{2027-02-11T04:30: 45}``.
    lines : str
        CSV table of known lines, with columns frequency_mhz and source.
    comb : {"found", "always", "never"}
        Search every spectrum for the calibrator's comb, or assume that it is always or never on.
    false_alarm : float
        Probability that a test flags a value of pure noise, for each kind of test.
    leave_out : bool
        Flag time bins, single values, products and days that are inconsistent with the rest of the
        data.
    simulated : FlightSimulatedSection
        Simulated sessions and their disturbances.
    """

    gain_table: str | None = None
    gain_model: Literal["quadratic", "linear"] = "quadratic"
    component_std: Annotated[tuple[Positive, ...], Field(min_length=2, max_length=2)] | None = None
    gain_std: Positive | None = None
    bin_origin: BinOrigin | None = None
    clock: str | None = None
    site: Literal["file", "scenario"] = "file"
    bandwidth_hz: Positive = 1.0e6
    degree: Annotated[int, Field(ge=0, le=6)] = 2
    filter_taps: Annotated[int, Field(ge=0, le=64)] = 0
    filter_window: Taper = "hann"
    convention: Literal["s_i conj(s_j)", "conj(s_i) s_j"] = "s_i conj(s_j)"
    per_kelvin_v2_hz: Positive | None = None
    turntable_deg: Angle = 0.0
    turns: dict[str, Angle] = Field(default_factory=dict)
    lines: str | None = None
    comb: Literal["found", "always", "never"] = "found"
    false_alarm: Rare = 1e-4
    leave_out: bool = True
    simulated: FlightSimulatedSection | None = None

    _gains_are_positive = requires(
        lambda section: section.gain_std is None or section.gain_std < 1.0,
        "gain_std is relative to the gain; set it below 1",
    )

    @property
    def bandwidth_mhz(self) -> float:
        """Width of the band."""
        return self.bandwidth_hz / 1e6

    @property
    def sign(self) -> int:
        """Sign that converts the spectrometer's imaginary parts to those of <s_i conj(s_j)>."""
        return int(products.CONVENTIONS[self.convention])

    def angles_at(self, times: Time) -> arrays.Times:
        """Return the turntable's angle at these times; InputError if ``turns`` has other keys."""
        with reading.naming("flight.turns"):
            starts = [float(utc_times(start).jd[0]) for start in self.turns]
        angles = [x for _, x in sorted(zip(starts, self.turns.values(), strict=True))]
        number = np.searchsorted(np.sort(starts), times.jd, side="right")
        return np.array([self.turntable_deg, *angles])[number]


@dataclass(frozen=True, eq=False)
class Recipe:
    """How sessions are reduced.

    Attributes
    ----------
    section : FlightSection
        With a ``bin_origin``.
    table : GainModel
    timestamp : {"start", "middle", "end", "instant"}
        Meaning of the times of spectra.
    frequencies_mhz : tuple of float
        Middles of the bands.
    average_s : float or None
        Length of averages in time; None for no averaging.
    lines_mhz : tuple of float
        Frequencies of known lines.
    clock : Clock or None
        Clock from outside the sessions.
    site : (float, float) or None
        Longitude and latitude in degrees, in place of those of the files.
    """

    section: FlightSection
    table: GainModel
    timestamp: Timestamp
    frequencies_mhz: tuple[float, ...]
    average_s: float | None = None
    lines_mhz: tuple[float, ...] = ()
    clock: Clock | None = None
    site: tuple[float, float] | None = None

    def words(self) -> dict[str, str]:
        """Return a description of the reduction, a line for each choice."""
        section = self.section
        bin_part = {"centre": "centre", "edge": "lower edge"}[section.bin_origin]
        times = "instants" if self.timestamp == "instant" else f"{self.timestamp} of integrations"
        return {
            "gain table": f"{Path(self.table.path).name} ({self.table.kind})",
            "frequencies": f"the {bin_part} of channel k is at k times 25 kHz",
            "bands": f"polynomial of degree {section.degree} over {section.bandwidth_mhz:g} MHz",
            "times": times,
            "site": "of the scenario" if self.site else "of the sessions",
        }


SAME_SITE_DEG = 1e-6


@dataclass(frozen=True, eq=False)
class Timeline:
    """The spectra of all sessions.

    Attributes
    ----------
    sessions : tuple of Session
        In order of time.
    observation : Observation
        A sample for each spectrum; a run for each state of the spectrometer: session, gains,
        averaging.
    session : (rows,) array of int
        Session of each spectrum.
    row : (rows,) array of int
        Number of each spectrum within its session.
    bin_of : (rows,) array of int
        Time bin of each spectrum.
    """

    sessions: tuple[Session, ...]
    observation: Observation
    session: Int[np.ndarray, " rows"]
    row: Int[np.ndarray, " rows"]
    bin_of: Int[np.ndarray, " rows"]


def timeline(sessions: Sequence[Session], recipe: Recipe) -> Timeline:
    """Sort sessions by time, and assign their spectra to time bins.

    A bin ends where the state of the spectrometer changes.

    Parameters
    ----------
    sessions : sequence of Session
    recipe : Recipe

    Raises
    ------
    InputError
        If a clock is unknown or contradicts another, sessions overlap or have different sites, and
        as :func:`.bins_of`.
    """
    timed = [(s, clock_of(s.path, s.clock, recipe.clock, s.raw_s).utc(s.raw_s)) for s in sessions]
    timed.sort(key=lambda one: one[1][0].jd)
    for (a, times_a), (b, times_b) in pairwise(timed):
        if times_b[0] <= times_a[-1]:
            raise InputError(
                f"{a.path} ({times_a[0].isot[:19]} to {times_a[-1].isot[:19]}) and {b.path} "
                f"({times_b[0].isot[:19]} to {times_b[-1].isot[:19]}) overlap in time; drop one"
            )
    ordered = tuple(s for s, _ in timed)
    lon, lat = _site(ordered) if recipe.site is None else recipe.site
    window = np.concatenate([s.window_s for s in ordered])
    share = np.concatenate([s.share for s in ordered])
    times = utc_of(*(np.concatenate([getattr(t, n) for _, t in timed]) for n in ("jd1", "jd2")))
    windows = None
    if recipe.timestamp != "instant":
        times = later(times, TO_MIDDLE[recipe.timestamp] * window)
        # a spectrum of no frames has no data, whatever its live time
        live_s = np.where(share > 0.0, share, 1.0) * window
        windows = contiguous(times, window / 2.0, float(window.min()), live_s)
        # a spectrum during which the turntable turns belongs to no angle; turns are stated to 1 ms
        inner = window / 2.0 - 1e-3
        ends = (recipe.section.angles_at(later(times, s * inner)) for s in (-1.0, 1.0))
        turns = np.split(np.not_equal(*ends), np.cumsum([s.n_rows for s in ordered])[:-1])
        pairs = zip(ordered, turns, strict=True)
        ordered = tuple(replace(s, share=np.where(turn, 0.0, s.share)) for s, turn in pairs)
    # a state has one Navgf, length, angle and set of gains; compared as text, like the levels
    session = np.repeat(np.arange(len(ordered)), [s.n_rows for s in ordered])
    settings = [np.column_stack([s.navgf, s.navg_shift, s.level]) for s in ordered]
    angle = recipe.section.angles_at(times)
    states = np.column_stack([session, angle, np.concatenate(settings)])
    changes = np.append(True, (states[1:] != states[:-1]).any(axis=1))
    state = np.cumsum(changes) - 1
    with reading.naming(", ".join(str(s.path) for s in ordered)):
        angles, longest = tuple(angle[changes].tolist()), float(window.max())
        observation = Observation(lon, lat, times, state, angles, longest, windows=windows)
    bin_of = np.arange(len(state))
    if recipe.average_s is not None:
        bin_of = averaging.bins_of(observation, recipe.average_s)
    row = np.concatenate([np.arange(s.n_rows) for s in ordered])
    return Timeline(ordered, observation, session, row, bin_of)


def _site(sessions: Sequence[Session]) -> tuple[float, float]:
    first = sessions[0]
    for other in sessions[1:]:
        east = (other.lon_deg - first.lon_deg + 180.0) % 360.0 - 180.0
        if max(abs(east), abs(other.lat_deg - first.lat_deg)) > SAME_SITE_DEG:
            raise InputError(
                f"{first.path} is at longitude {first.lon_deg:g}, latitude {first.lat_deg:g} "
                f"degrees, {other.path} at {other.lon_deg:g}, {other.lat_deg:g}; if the site in "
                "the files is a placeholder, use --set flight.site=scenario"
            )
    return first.lon_deg, first.lat_deg
