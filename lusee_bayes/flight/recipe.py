"""How sessions are reduced, and all their spectra in the order of their times."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Literal

import numpy as np
from astropy.time import Time
from jaxtyping import Int

from lusee_bayes.core.errors import InputError
from lusee_bayes.core.reading import naming
from lusee_bayes.flight.clock import Clock, clock_of
from lusee_bayes.flight.flags import NO_LINES, KnownLines
from lusee_bayes.flight.gain_model import GainModel
from lusee_bayes.flight.session import BinOrigin, Session
from lusee_bayes.instrument.averaging import bins_of
from lusee_bayes.instrument.observation import Observation
from lusee_bayes.instrument.times import TO_MIDDLE, Timestamp, Windows, later


@dataclass(frozen=True, eq=False)
class Recipe:
    """How sessions are reduced.

    Attributes
    ----------
    table : GainModel
    origin : {"centre", "edge"}
        What of channel k lies at k times 25 kHz.
    timestamp : {"start", "middle", "end", "instant"}
        What the times of spectra are.
    frequencies_mhz : tuple of float
        Middles of the bands.
    bandwidth_mhz : float
    degree : int
        Of the polynomial over a band (:mod:`.bands`).
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

    table: GainModel
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


SAME_SITE_DEG = 1e-6


@dataclass(frozen=True, eq=False)
class Timeline:
    """The spectra of all sessions.

    Attributes
    ----------
    sessions : tuple of Session
        In the order of their times.
    observation : Observation
        A sample for each spectrum; a run for each state of the spectrometer: session, gains,
        averaging.
    session : (rows,) array of int
        Of each spectrum.
    row : (rows,) array of int
        Its number within the session.
    bin_of : (rows,) array of int
        The bin of time that it belongs to.
    """

    sessions: tuple[Session, ...]
    observation: Observation
    session: Int[np.ndarray, " rows"]
    row: Int[np.ndarray, " rows"]
    bin_of: Int[np.ndarray, " rows"]

    @property
    def n_bins(self) -> int:
        """Number of bins of time."""
        return int(self.bin_of[-1]) + 1


def timeline(sessions: Sequence[Session], recipe: Recipe) -> Timeline:
    """Put sessions in order, and cut their time into bins.

    A bin ends where the state of the spectrometer changes.

    Parameters
    ----------
    sessions : sequence of Session
    recipe : Recipe

    Raises
    ------
    InputError
        If a clock is not known or contradicts another, sessions overlap or have different sites,
        or instants are to be averaged.
    """
    if recipe.timestamp == "instant" and recipe.average_s is not None:
        raise InputError(
            "the times of the spectra are said to be instants (observation.timestamp=instant), "
            "which have no mean over a time; leave out observation.average_s, or say "
            "observation.timestamp=middle"
        )
    found = [(s, clock_of(s.path, s.clock, recipe.clock, s.raw_s).utc(s.raw_s)) for s in sessions]
    found.sort(key=lambda one: one[1][0].jd)
    for (a, times_a), (b, times_b) in pairwise(found):
        if times_b[0] <= times_a[-1]:
            raise InputError(
                f"{a.path} ({times_a[0].isot[:19]} to {times_a[-1].isot[:19]}) and {b.path} "
                f"({times_b[0].isot[:19]} to {times_b[-1].isot[:19]}) overlap in time; give each "
                "spectrum once"
            )
    lon, lat = _site([s for s, _ in found]) if recipe.site is None else recipe.site
    ordered = tuple(s for s, _ in found)
    window = np.concatenate([s.window_s for s in ordered])
    share = np.concatenate([s.share for s in ordered])
    times = Time(
        np.concatenate([t.jd1 for _, t in found]),
        np.concatenate([t.jd2 for _, t in found]),
        format="jd",
        scale="utc",
    )
    windows = None
    if recipe.timestamp != "instant":
        times = later(times, TO_MIDDLE[recipe.timestamp] * window)
        windows = Windows.whole(-window / 2.0, window / 2.0, share * window)
    state = _states(ordered)
    with naming(", ".join(str(s.path) for s in ordered)):
        angles = (recipe.turntable_deg,) * (int(state[-1]) + 1)
        longest = float(window.max())
        observation = Observation(lon, lat, times, state, angles, longest, windows=windows)
    bin_of = np.arange(len(state))
    if recipe.average_s is not None:
        bin_of = bins_of(observation, windows.bounds_s, recipe.average_s)
    session = np.repeat(np.arange(len(ordered)), [s.n_rows for s in ordered])
    row = np.concatenate([np.arange(s.n_rows) for s in ordered])
    return Timeline(ordered, observation, session, row, bin_of)


def _site(sessions: Sequence[Session]) -> tuple[float, float]:
    first = sessions[0]
    for other in sessions[1:]:
        differ = max(abs(other.lon_deg - first.lon_deg), abs(other.lat_deg - first.lat_deg))
        if differ > SAME_SITE_DEG:
            raise InputError(
                f"{first.path} is of longitude {first.lon_deg:g}, latitude {first.lat_deg:g} "
                f"degrees, {other.path} of {other.lon_deg:g}, {other.lat_deg:g}; where the files "
                "have a site that nobody has established, use --set flight.site=scenario"
            )
    return first.lon_deg, first.lat_deg


def _states(sessions: Sequence[Session]) -> Int[np.ndarray, " rows"]:
    """Numbers that grow wherever session, gains or averaging change."""
    changes = []
    for session in sessions:
        same = (
            (np.diff(session.navgf) == 0)
            & (np.diff(session.navg_shift) == 0)
            & (session.level[1:] == session.level[:-1]).all(axis=1)
        )
        changes.append(np.concatenate([[True], ~same]))
    return np.cumsum(np.concatenate(changes)) - 1
