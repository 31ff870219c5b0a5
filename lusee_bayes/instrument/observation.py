"""Site, times and turntable angles of an observation, and the orientation of the Moon.

Frames: Galactic (of the sky), MCMF (fixed to the Moon, from lunarsky), topocentric (x East,
y North, z up). Orientations come from lunarsky's own coordinate transformation at every time:
nothing assumes that the Moon turns about a fixed axis, unless ``fixed_axis`` asks for it.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property

import astropy.units as u
import erfa
import numpy as np
from astropy.coordinates import ICRS, CartesianRepresentation, Galactic, get_body_barycentric
from astropy.time import Time
from jaxtyping import Bool, Float, Int
from lunarsky import MCMF
from scipy.spatial.transform import Rotation as SpatialRotation

from lusee_bayes.core.checks import require_finite, require_positive
from lusee_bayes.core.errors import InputError
from lusee_bayes.core.representation import Described, listed

CYCLE_DAYS = 27.321661
# period after which the sky repeats itself in luseepy's engine croissant
LUSEEPY_MONTH_HOURS = 655.72
EPHEMERIS_YEARS = (1900, 2050)


@dataclass(frozen=True)
class Run:
    """A stretch of data taken at one turntable angle.

    Attributes
    ----------
    cycles : float
        Length in sidereal months of 27.321661 days.
    turntable_deg : float
        A positive angle turns the antennas from East towards North.
    night_only : bool
        Keep only the samples with the Sun below the horizon.
    """

    cycles: float = 1.0
    turntable_deg: float = 0.0
    night_only: bool = False


@dataclass(frozen=True, repr=False)
class Observation(Described):
    """The samples of one or more runs at one site.

    Attributes
    ----------
    lon_deg, lat_deg : float
        Selenographic longitude and latitude of the site.
    times : (times,) Time
        UTC of every sample, one run after the other.
    run : (times,) array of int
        The run that each sample belongs to: 0, 1, ... without going back.
    turntable_deg : (runs,) tuple of float
        Turntable angle of each run.
    step_s : float
        Integration time of a sample in seconds.
    fixed_axis : bool
        Turn the sky once in 655.72 hours about the axis of the first sample, as
        luseepy's engine croissant does. Wrong by several times the radiometer noise, but so are
        its data.

    Raises
    ------
    InputError
        For a latitude, step, time or run number that is impossible, and for times outside the
        ephemeris.
    """

    lon_deg: float
    lat_deg: float
    times: Time
    run: Int[np.ndarray, " times"]
    turntable_deg: tuple[float, ...]
    step_s: float
    fixed_axis: bool = False

    def __post_init__(self):
        if not -90.0 <= self.lat_deg <= 90.0:
            raise InputError(f"lat_deg must lie in -90..90, got {self.lat_deg}")
        require_positive("step_s", self.step_s)
        require_finite("lon_deg and turntable_deg", np.array([self.lon_deg, *self.turntable_deg]))
        if self.times.shape != self.run.shape or self.times.ndim != 1 or not self.times.size:
            raise InputError(
                f"times {self.times.shape} and run {self.run.shape} must be two lists of the "
                "same length, with at least one sample"
            )
        with unannounced_leap_seconds():
            back = np.flatnonzero(~((self.times[1:] - self.times[:-1]).to_value(u.s) > 0.0))
        if back.size:
            before, after = self.times[back[0]].isot, self.times[back[0] + 1].isot
            raise InputError(
                f"times must grow from sample to sample, but sample {back[0] + 1} ({after}) does "
                f"not come after sample {back[0]} ({before}); sort them, and give each time once"
            )
        steps = np.diff(self.run)
        if (
            self.run[0] != 0
            or self.run[-1] != len(self.turntable_deg) - 1
            or not ((steps == 0) | (steps == 1)).all()
        ):
            raise InputError(
                f"run must count 0, 1, ... up to {len(self.turntable_deg) - 1} (one number for "
                "each turntable angle) without going back"
            )
        require_ephemeris(self.times.jd)

    def description(self) -> tuple[str, ...]:
        with unannounced_leap_seconds():
            first, last = self.times[0].isot[:19], self.times[-1].isot[:19]
        angles = listed(tuple(f"{angle:g}" for angle in self.turntable_deg))
        axis = ", with a fixed axis of the Moon" if self.fixed_axis else ""
        return (
            f"longitude {self.lon_deg:g}, latitude {self.lat_deg:g} degrees{axis}",
            f"{first} to {last} UTC, {self.n_times} samples of {self.step_s:g} s",
            f"{self.n_runs} run{'s' * (self.n_runs > 1)}, turntable at {angles} degrees",
        )

    @classmethod
    def from_runs(
        cls,
        runs: list[Run] | tuple[Run, ...] = (Run(),),
        *,
        start: str = "2027-01-15T00:00:00",
        step_s: float = 7200.0,
        lon_deg: float = 182.258,
        lat_deg: float = -23.814,
        fixed_axis: bool = False,
    ) -> Observation:
        """Return an observation of runs that follow one another; defaults as in the paper.

        A run of c cycles holds floor(c cycle / step_s) samples, start + k step_s; the next begins
        c cycles later.

        Parameters
        ----------
        runs : sequence of Run
        start : str
            UTC, ISO.
        step_s : float
            Time from sample to sample, and integration time, in seconds.
        lon_deg, lat_deg : float
        fixed_axis : bool
            See :class:`Observation`.

        Returns
        -------
        Observation

        Raises
        ------
        InputError
            For a bad date, step or length, and for a run without samples.
        """
        require_positive("step_s", step_s)
        if not runs:
            raise InputError("an observation needs at least one run, got none")
        t0 = utc_from_text("start", start)
        elapsed, offsets, numbers = 0.0, [], []
        for number, run in enumerate(runs):
            require_positive(f"the length in cycles of run {number}", run.cycles)
            length = run.cycles * CYCLE_DAYS * 86400.0
            n = int(length // step_s)
            if n < 1:
                raise InputError(
                    f"run {number} of {run.cycles} cycles holds no sample of {step_s} s; "
                    "lengthen it or shorten step_s"
                )
            offsets.append(elapsed + step_s * np.arange(n))
            numbers.append(np.full(n, number))
            elapsed += length
        seconds, run_of = np.concatenate(offsets), np.concatenate(numbers)
        require_ephemeris(np.array([t0.jd + seconds[-1] / 86400.0]))
        with unannounced_leap_seconds():
            times = t0 + seconds * u.s
        observation = cls(
            lon_deg,
            lat_deg,
            times,
            run_of,
            tuple(r.turntable_deg for r in runs),
            step_s,
            fixed_axis,
        )
        night_runs = np.array([r.night_only for r in runs])
        if not night_runs.any():
            return observation
        keep = ~night_runs[run_of] | (observation.sun_altitude_deg() < 0.0)
        empty = [i for i in range(len(runs)) if not keep[run_of == i].any()]
        if empty:
            raise InputError(
                f"run {empty[0]} holds no lunar night; lengthen it, move its start or drop "
                "night_only"
            )
        return observation.select(keep)

    def select(self, keep: Bool[np.ndarray, " times"]) -> Observation:
        """Return the observation with only the samples where ``keep`` is True.

        Runs without any sample are left out.

        Raises
        ------
        InputError
            If no sample is kept.
        """
        runs, renumbered = np.unique(self.run[keep], return_inverse=True)
        return Observation(
            self.lon_deg,
            self.lat_deg,
            self.times[keep],
            renumbered,
            tuple(self.turntable_deg[run] for run in runs),
            self.step_s,
            self.fixed_axis,
        )

    @property
    def n_times(self) -> int:
        """Number of samples over all runs."""
        return len(self.run)

    @property
    def n_runs(self) -> int:
        """Number of runs."""
        return len(self.turntable_deg)

    @property
    def hours(self) -> Float[np.ndarray, " times"]:
        """Hours since the first sample."""
        with unannounced_leap_seconds():
            tdb = self.times.tdb
        return (tdb - tdb[0]).to_value(u.hour)

    def mcmf_from_galactic(self) -> Float[np.ndarray, "times 3 3"]:
        """Return the rotations that take Galactic unit vectors to MCMF ones at every time."""
        return self._mcmf_from_galactic

    @cached_property
    def _mcmf_from_galactic(self) -> Float[np.ndarray, "times 3 3"]:
        if self.fixed_axis:
            angle = 2.0 * np.pi * self.hours / LUSEEPY_MONTH_HOURS
            about_z = SpatialRotation.from_rotvec(np.outer(-angle, [0.0, 0.0, 1.0])).as_matrix()
            rotations = about_z @ mcmf_from_galactic(self.times[:1])[0]
        else:
            rotations = mcmf_from_galactic(self.times)
        rotations.setflags(write=False)  # all channels share them
        return rotations

    def topocentric_from_mcmf(self) -> Float[np.ndarray, "3 3"]:
        """Return the rotation from MCMF to the East, North and up of the site, its rows."""
        lon, lat = np.radians(self.lon_deg), np.radians(self.lat_deg)
        up = np.array([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)])
        east = np.array([-np.sin(lon), np.cos(lon), 0.0])
        return np.array([east, np.cross(up, east), up])

    def zenith_galactic(self) -> Float[np.ndarray, "times 3"]:
        """Return the Galactic unit vector of the zenith at every time."""
        return self.topocentric_from_mcmf()[2] @ self.mcmf_from_galactic()

    def sun_altitude_deg(self) -> Float[np.ndarray, " times"]:
        """Return the geometric altitude of the Sun's centre above the horizon in degrees."""
        with unannounced_leap_seconds():
            sun = get_body_barycentric("sun", self.times, ephemeris="builtin")
            moon = get_body_barycentric("moon", self.times, ephemeris="builtin")
        direction = (sun - moon).xyz.to_value(u.km)
        galactic = ICRS(CartesianRepresentation(direction)).transform_to(Galactic())
        vector = galactic.cartesian.xyz.value
        vector = vector / np.linalg.norm(vector, axis=0)
        height = np.einsum("ti,it->t", self.zenith_galactic(), vector)
        return np.degrees(np.arcsin(height))


@contextmanager
def unannounced_leap_seconds() -> Iterator[None]:
    """Silence ERFA's warning that UTC of coming years may get more leap seconds."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", erfa.ErfaWarning)
        yield


def utc_from_text(name: str, text: str) -> Time:
    """Return the time of an ISO date in UTC.

    Raises
    ------
    InputError
        If it is none, or outside the ephemeris; the message begins with ``name``.
    """
    try:
        with unannounced_leap_seconds():
            time = Time(text, scale="utc")
    except (ValueError, TypeError) as error:
        raise InputError(
            f"{name} '{text}' is not a date; write it as 2027-01-15T00:00:00"
        ) from error
    require_ephemeris(np.atleast_1d(time.jd))
    return time


def require_ephemeris(jd: Float[np.ndarray, " times"]) -> None:
    """Check that Julian dates lie within lunarsky's kernel of the Moon's orientation.

    Raises
    ------
    InputError
        If one does not.
    """
    first, last = (Time(f"{year}-01-01", scale="tdb").jd for year in EPHEMERIS_YEARS)
    outside = ~((jd >= first) & (jd <= last))
    if not outside.any():
        return
    at = float(jd[outside][0])
    date = f"Julian date {at:.6g}"
    if 0.0 < at < 5373484.0:  # years of four digits
        with unannounced_leap_seconds():
            date = Time(at, format="jd").isot[:19]
    raise InputError(
        f"sample times run outside the ephemeris ({EPHEMERIS_YEARS[0]}-{EPHEMERIS_YEARS[1]}): "
        f"{date}; give a start inside it"
    )


def mcmf_from_galactic(times: Time) -> Float[np.ndarray, "times 3 3"]:
    """Return the rotations that take Galactic unit vectors to MCMF ones.

    The three Galactic axes go through lunarsky's ICRS -> MCMF transformation in one call.
    """
    axes = Galactic(CartesianRepresentation(np.eye(3)[:, :, None])).transform_to(ICRS())
    icrs = ICRS(CartesianRepresentation(axes.cartesian.xyz.value))
    with unannounced_leap_seconds():
        turned = icrs.transform_to(MCMF(obstime=times))
    return np.moveaxis(turned.cartesian.xyz.value, 2, 0)
