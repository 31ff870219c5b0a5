"""An observation: the orientation of the sky in the antennas' frame at every time.

Frames: Galactic (of the sky), MCMF (fixed to the Moon, from lunarsky), topocentric (x East,
y North, z up). Orientations come from lunarsky's own coordinate transformation at every time:
the Moon's axis is fixed only if ``fixed_axis`` is set.

:func:`site_of` and :func:`runs_of` convert the sites and turntable angles that come with arrays.

Directions from the lander to the Sun, the Earth and the planets come from ERFA's analytical series
(astropy's ``builtin``; nothing is downloaded). They are accurate to 1e-7 au for the Earth and the
Sun, 10 arcseconds for the Moon, 90 arcseconds for Jupiter, Saturn and Uranus, and 20 for the other
planets (notes of erfa.epv00, moon98 and plan94).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from functools import cached_property
from typing import Any, Literal, get_args

import astropy.units as u
import numpy as np
from astropy.constants import c
from astropy.coordinates import ICRS, CartesianRepresentation, Galactic, get_body_barycentric
from astropy.time import Time, TimeDelta
from jaxtyping import Bool, Float, Int
from lunarsky import MCMF
from scipy.spatial.transform import Rotation as SpatialRotation

from lusee_bayes.core import arrays, checks
from lusee_bayes.core.errors import InputError, nearest, refusing, require_known
from lusee_bayes.instrument import times
from lusee_bayes.instrument.schedule import Cut, Interval, Run, cut_intervals, cut_runs

Vectors, Turn = Float[np.ndarray, "times 3"], Float[np.ndarray, "3 3"]
Window = Literal["instant", "mean"]
ONE_CYCLE = (Run(),)
# rotation period of the sky in luseepy's engine croissant
LUSEEPY_MONTH_HOURS = 655.72


@dataclass(frozen=True, repr=False)
class Observation(checks.Described):
    """The samples of one or more runs at one site.

    Attributes
    ----------
    lon_deg, lat_deg : float
        Selenographic longitude and latitude of the site.
    times : (times,) Time
        UTC of every sample, run by run: the middle of its window, or the instant.
    run : (times,) array of int
        Run number of each sample: 0, 1, ..., non-decreasing.
    turntable_deg : (runs,) tuple of float
        Turntable angle of each run.
    step_s : float
        Time from sample to sample, in seconds; without windows also the integration time.
    fixed_axis : bool
        Turn the sky once in 655.72 hours about the axis of the first sample, as luseepy's engine
        croissant does. The error is several times the radiometer noise, but luseepy's data, which
        have no windows, contain it too.
    windows : Windows or None
        The windows over which samples are means; None for instants.
    tilt_deg : (float, float)
        How far the lander leans towards East and towards North.

    Raises
    ------
    InputError
        For an impossible latitude, step, time or run number, for times outside the ephemeris, and
        for windows that overlap or are longer than a step.
    """

    lon_deg: float
    lat_deg: float
    times: Time
    run: Int[np.ndarray, " times"]
    turntable_deg: tuple[float, ...]
    step_s: float
    fixed_axis: bool = False
    windows: times.Windows | None = None
    tilt_deg: tuple[float, float] = (0.0, 0.0)

    def __post_init__(self):
        if not -90.0 <= self.lat_deg <= 90.0:
            raise InputError(f"lat_deg must lie in -90..90, got {self.lat_deg}")
        checks.require_positive("step_s", self.step_s)
        checks.require_finite("lon_deg and turntable_deg", [self.lon_deg, *self.turntable_deg])
        checks.require_finite("tilt_deg", self.tilt_deg)
        checks.require_shape("times", self.times, (None,))
        object.__setattr__(self, "times", self.times.utc)
        checks.require_shape("run", self.run, self.times.shape)
        back = np.flatnonzero(~(times.seconds_from(self.times[:-1], self.times[1:]) > 0.0))
        if back.size:
            before, after = self.times[back[0]].isot, self.times[back[0] + 1].isot
            raise InputError(
                f"times must increase, but sample {back[0] + 1} ({after}) is not later than sample "
                f"{back[0]} ({before}); sort them, and give each time once"
            )
        last = self.n_runs - 1
        if not times.counts_up(self.run) or self.run[-1] != last:
            raise InputError(
                f"run must count 0, 1, ... up to {last}, one per turntable angle, never decreasing"
            )
        times.require_ephemeris(self.times.jd)
        if self.windows is None:
            return
        if self.fixed_axis:
            raise InputError(
                "a fixed lunar axis needs samples that are instants; use observation.window=instant"
            )
        self.windows.require_fitting(self.times, self.step_s)

    def description(self) -> tuple[str, ...]:
        with times.unannounced_leap_seconds():
            first, last = self.times[0].isot[:19], self.times[-1].isot[:19]
        angles = checks.listed(tuple(f"{angle:g}" for angle in self.turntable_deg))
        samples = "times are instants" if self.windows is None else self.windows.description()[0]
        axis = ", with a fixed axis of the Moon" if self.fixed_axis else ""
        return (
            f"longitude {self.lon_deg:g}, latitude {self.lat_deg:g} degrees{axis}",
            f"{first} to {last} UTC, {self.n_times} samples of {self.step_s:g} s",
            f"{self.n_runs} run{'s' * (self.n_runs > 1)}, turntable at {angles} degrees; {samples}",
        )

    @classmethod
    def from_runs(
        cls,
        runs: Sequence[Run] = ONE_CYCLE,
        *,
        start: str | datetime | Time = "2027-01-15T00:00:00",
        step_s: float = 7200.0,
        lon_deg: float = 182.258,
        lat_deg: float = -23.814,
        fixed_axis: bool = False,
        window: Window = "instant",
    ) -> Observation:
        """Return an observation of consecutive runs; defaults as in the paper.

        A run of c cycles has floor(c cycle / step_s) samples, start + k step_s; the next begins
        c cycles later.

        Parameters
        ----------
        runs : sequence of Run
        start : str
            UTC; a text in ISO's format, or another date.
        step_s : float
            Time from sample to sample, and integration time, in seconds.
        lon_deg, lat_deg : float
        fixed_axis : bool
            See :class:`Observation`.
        window : {"instant", "mean"}
            Whether a sample is the sky at the beginning of its step, as in the paper, or the mean
            over the step.

        Returns
        -------
        Observation

        Raises
        ------
        InputError
            For a bad date, step or length, and for a run without samples.
        """
        cuts, t0 = cut_runs(runs, step_s), times.time_of_text("start", start)
        place = {"lon_deg": lon_deg, "lat_deg": lat_deg, "step_s": step_s, "fixed_axis": fixed_axis}
        place["turntable_deg"] = tuple(run.turntable_deg for run in runs)
        return cls._of_cuts(cuts, t0, np.arange(len(runs)), window, **place)

    @classmethod
    def from_schedule(
        cls,
        intervals: Sequence[Interval],
        *,
        step_s: float = 7200.0,
        lon_deg: float = 182.258,
        lat_deg: float = -23.814,
        fixed_axis: bool = False,
        window: Window = "mean",
    ) -> Observation:
        """Return an observation of the intervals of a schedule.

        Each is cut into windows of ``step_s`` from its start; the last is shorter if the interval
        does not end on a step. A run begins wherever the turntable angle changes.

        Parameters
        ----------
        intervals : sequence of Interval
            In order of time, for example from :func:`.read_schedule`.
        step_s : float
            Time from sample to sample within an interval, in seconds.
        lon_deg, lat_deg : float
        fixed_axis : bool
            See :class:`Observation`.
        window : {"instant", "mean"}
            Whether a sample is the sky at the beginning of its window or the mean over it.

        Returns
        -------
        Observation

        Raises
        ------
        InputError
            If intervals overlap or are out of order, if instants have a duty cycle, and if a
            night-only interval contains no night.
        """
        cuts, angles = cut_intervals(intervals, step_s), [one.turntable_deg for one in intervals]
        place = {"lon_deg": lon_deg, "lat_deg": lat_deg, "step_s": step_s, "fixed_axis": fixed_axis}
        number, place["turntable_deg"] = runs_of(angles, len(intervals))
        return cls._of_cuts(cuts, intervals[0].start_time, number, window, **place)

    @classmethod
    def _of_cuts(
        cls, cuts: Sequence[Cut], t0: Time, number: times.Numbers, window: Window, **place: Any
    ) -> Observation:
        """Build from samples of cuts, only at night if requested; ``number``: the run of each cut.

        A window of a schedule must be dark from start to end, a window of a run at its middle.
        """
        require_known("unknown window", window, get_args(Window))
        times_s, length_s, live_s = np.concatenate([cut.samples_s for cut in cuts], axis=1)
        times.require_ephemeris(np.array([t0.jd + times_s[-1] / 86400.0]))
        cut_of = np.repeat(np.arange(len(cuts)), [cut.samples_s.shape[1] for cut in cuts])
        windows = None
        if window == "mean":
            half = length_s / 2.0
            times_s, windows = times_s + half, times.Windows.whole(-half, half, live_s)
        elif (live_s < length_s).any():
            raise InputError(
                "samples that are instants have no duty cycle; use windows "
                "(observation.window=mean), or remove the schedule's duty_cycle"
            )
        at = times.later(t0, times_s)
        observation = cls(times=at, run=number[cut_of], windows=windows, **place)
        if not (night_only := np.array([cut.of.night_only for cut in cuts])).any():
            return observation
        dark = observation.sun_altitude_deg() < 0.0
        if windows is not None and isinstance(cuts[0].of, Interval):
            for offset_s in windows.bounds_s.T:
                at_end = replace(observation, times=times.later(at, offset_s), windows=None)
                dark &= at_end.sun_altitude_deg() < 0.0
        keep = dark | ~night_only[cut_of]
        for k, cut in enumerate(cuts):
            if not keep[cut_of == k].any():
                why = f"{cut.name} contains no lunar night; lengthen it, move it or drop night_only"
                raise InputError(why)
        return observation.select(keep)

    def select(self, keep: Bool[np.ndarray, " times"]) -> Observation:
        """Return the observation with only the samples where ``keep`` is True.

        Runs without any sample are dropped.

        Raises
        ------
        InputError
            If no sample is kept.
        """
        runs, run = np.unique(self.run[keep], return_inverse=True)
        angles = tuple(self.turntable_deg[number] for number in runs)
        windows = None if self.windows is None else self.windows.select(keep)
        return replace(self, times=self.times[keep], run=run, turntable_deg=angles, windows=windows)

    @property
    def n_times(self) -> int:
        """Number of samples over all runs."""
        return len(self.run)

    @property
    def n_runs(self) -> int:
        """Number of runs."""
        return len(self.turntable_deg)

    @property
    def live_s(self) -> arrays.Times:
        """Integration time of every sample, in seconds."""
        steps = np.full(self.n_times, float(self.step_s))
        return steps if self.windows is None else self.windows.live_per_sample_s

    def at_nodes(self, n: int) -> tuple[Observation, times.Numbers, times.Nodes]:
        """Return the observation at instants whose weighted means equal those over the windows.

        Parameters
        ----------
        n : int
            Instants in each piece of a window, see :meth:`.Windows.nodes`.

        Returns
        -------
        observation : Observation
            At the instants; ``self`` if it has no windows.
        sample : (nodes,) array of int
            Sample number of every instant, non-decreasing.
        weight : (nodes,) array
            Weights that sum to 1 for each sample.
        """
        if self.windows is None:
            return self, np.arange(self.n_times), np.ones(self.n_times)
        sample, offset_s, weight = self.windows.nodes(n)
        at, run = times.later(self.times[sample], offset_s), self.run[sample]
        return replace(self, times=at, run=run, windows=None), sample, weight

    @cached_property
    def hours(self) -> arrays.Times:
        """Hours since the first sample."""
        with times.unannounced_leap_seconds():
            tdb = self.times.tdb
        return (tdb - tdb[0]).to_value(u.hour)

    @property
    def day(self) -> Int[np.ndarray, " times"]:
        """Number of whole 24-hour days since the first sample."""
        return np.floor(self.hours / 24.0).astype(int)

    @cached_property
    def mcmf_from_galactic(self) -> Float[np.ndarray, "times 3 3"]:
        """Rotations from Galactic to MCMF unit vectors at every time."""
        if self.fixed_axis:
            angle = 2.0 * np.pi * self.hours / LUSEEPY_MONTH_HOURS
            about_z = SpatialRotation.from_rotvec(np.outer(-angle, [0.0, 0.0, 1.0])).as_matrix()
            rotations = about_z @ mcmf_from_galactic(self.times[:1])[0]
        else:
            rotations = mcmf_from_galactic(self.times)
        rotations.setflags(write=False)  # all channels share them
        return rotations

    def topocentric_from_mcmf(self) -> Turn:
        """Return the rotation from MCMF to the site's East, North and up, its rows."""
        lon, lat = np.radians(self.lon_deg), np.radians(self.lat_deg)
        up = np.array([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)])
        east = np.array([-np.sin(lon), np.cos(lon), 0.0])
        return np.array([east, np.cross(up, east), up])

    def lander_from_mcmf(self) -> Turn:
        """Return the rotation from MCMF to the lander's axes: East, North and up if it is level.

        The lander leans first towards North, about East, then towards East, about North.
        """
        east, north = self.tilt_deg
        turned = SpatialRotation.from_euler("YX", [east, -north], degrees=True)
        return turned.inv().as_matrix() @ self.topocentric_from_mcmf()

    def zenith_galactic(self) -> Vectors:
        """Return the Galactic unit vector of the zenith at every time."""
        return self.topocentric_from_mcmf()[2] @ self.mcmf_from_galactic

    def antenna_directions(self, galactic: Float[np.ndarray, "..."]) -> Vectors:
        """Return the direction of a source in the frame of the antennas at every sample.

        The frame turns with the antennas: if they turn by psi from East towards North, a source
        turns by -psi. Stellar aberration (0.006 degrees) is neglected, as for all skies here.

        Parameters
        ----------
        galactic : (3,) or (times, 3) array
            Galactic unit vector of the source, fixed or at every sample.

        Returns
        -------
        (times, 3) array
            East, North and up components.

        Raises
        ------
        InputError
            If ``galactic`` is not a finite float64 array of one of these shapes.
        """
        shape = (3,) if galactic.ndim == 1 else (self.n_times, 3)
        checks.require_array("galactic", galactic, shape)
        vectors = np.broadcast_to(galactic, (self.n_times, 3))
        mcmf = np.einsum("tij,tj->ti", self.mcmf_from_galactic, vectors)
        east, north, up = self.lander_from_mcmf() @ mcmf.T
        turned = np.radians(np.asarray(self.turntable_deg, dtype=np.float64))[self.run]
        cos, sin = np.cos(turned), np.sin(turned)
        return np.stack([cos * east + sin * north, cos * north - sin * east, up], axis=1)

    def sun_altitude_deg(self) -> arrays.Times:
        """Return the geometric altitude of the Sun's centre above the horizon in degrees."""
        sun = _barycentric_km("sun", self.times) - _barycentric_km("moon", self.times)
        height = np.einsum("ti,ti->t", self.zenith_galactic(), sun)
        return np.degrees(np.arcsin(height / np.linalg.norm(sun, axis=1)))


def mcmf_from_galactic(at: Time) -> Float[np.ndarray, "times 3 3"]:
    """Return the rotations from Galactic to MCMF unit vectors.

    The three Galactic axes go through lunarsky's ICRS -> MCMF transformation in one call.
    """
    axes = Galactic(CartesianRepresentation(np.eye(3)[:, :, None])).transform_to(ICRS())
    icrs = ICRS(CartesianRepresentation(axes.cartesian.xyz.value))
    with times.unannounced_leap_seconds():
        turned = icrs.transform_to(MCMF(obstime=at))
    return np.moveaxis(turned.cartesian.xyz.value, 2, 0)


BODIES = ("Sun", "Mercury", "Venus", "Earth", "Mars", "Jupiter", "Saturn", "Uranus", "Neptune")

MOON_RADIUS_KM = 1737.4  # IAU mean radius
LIGHT_KM_PER_S = c.to_value(u.km / u.s)

# each iteration reduces the light time's error by v / c < 2e-4: three leave 0.1 us
LIGHT_TIME_ITERATIONS = 3


def body_direction(body: str, observation: Observation) -> Vectors:
    """Return the direction from the lander to a body at every sample.

    It points from the lander to the body's position when its light left. Stellar aberration (0.006
    degrees) is neglected, as for all skies here.

    Parameters
    ----------
    body : str
        One of ``BODIES``, in upper or lower case.
    observation : Observation

    Returns
    -------
    (times, 3) array
        Galactic unit vectors.

    Raises
    ------
    InputError
        If the body is unknown.
    """
    require_known("unknown body in the sky of the Moon:", body.capitalize(), BODIES)
    with times.unannounced_leap_seconds():
        arrival = observation.times.tdb
    lander = _barycentric_km("moon", arrival) + MOON_RADIUS_KM * observation.zenith_galactic()
    light_time = np.zeros(observation.n_times)
    for _ in range(LIGHT_TIME_ITERATIONS):
        departure = arrival - TimeDelta(light_time, format="sec", scale="tdb")
        vector = _barycentric_km(body.lower(), departure) - lander
        light_time = np.linalg.norm(vector, axis=1) / LIGHT_KM_PER_S
    return vector / np.linalg.norm(vector, axis=1, keepdims=True)


def _barycentric_km(body: str, at: Time) -> Vectors:
    """Position relative to the barycentre of the Solar System, along Galactic axes."""
    with times.unannounced_leap_seconds():
        place = get_body_barycentric(body, at, ephemeris="builtin").xyz.to_value(u.km)
    axes = ICRS(CartesianRepresentation(np.eye(3))).transform_to(Galactic())
    return (axes.cartesian.xyz.value @ place).T


# sites by name: selenographic longitude and latitude in degrees
SITES = {"LuSEE-Night": (182.258, -23.814)}


def site_of(site: Any) -> tuple[float, float]:
    """Return longitude and latitude in degrees, from a pair or from a name in ``SITES``.

    Raises
    ------
    InputError
        If it is neither.
    """
    if isinstance(site, str):
        sites = {name.lower(): place for name, place in SITES.items()}
        if site.lower() not in sites:
            why = f"unknown site '{site}'; {nearest(site, SITES)} (or give two angles in degrees)"
            raise InputError(why)
        return sites[site.lower()]
    wrong = f"the site is {site!r}; give longitude and latitude in degrees, or {', '.join(SITES)}"
    with refusing(wrong, TypeError, ValueError):
        lon, lat = (float(x) for x in site)
    return lon, lat


def numbers_of_times(name: str, values: Any, n_times: int) -> arrays.Times:
    """Return a finite number for each time, from one per time or one for all.

    Raises
    ------
    InputError
        If shape or values are wrong; the message starts with ``name``.
    """
    expected = f"give one finite number, or one for each of {n_times} times"
    with refusing(f"{name} is {values!r}; {expected}", TypeError, ValueError):
        numbers = np.asarray(values, dtype=np.float64)
    if numbers.shape not in ((), (n_times,)) or not np.isfinite(numbers).all():
        raise InputError(f"{name} has shape {numbers.shape}; {expected}")
    return np.broadcast_to(numbers, (n_times,))


def runs_of(turntable_deg: Any, n_times: int) -> tuple[np.ndarray, tuple[float, ...]]:
    """Return the run of each sample, and the turntable angle of each run.

    Parameters
    ----------
    turntable_deg : float or (times,) array
        A new run begins where the angle changes.
    n_times : int

    Raises
    ------
    InputError
        If there is neither one finite angle nor one for each time.
    """
    angles = numbers_of_times("turntable_deg", turntable_deg, n_times)
    run = np.concatenate([[0], np.cumsum(np.diff(angles) != 0.0)]).astype(np.int64)
    return run, tuple(angles[np.searchsorted(run, np.arange(run[-1] + 1))].tolist())
