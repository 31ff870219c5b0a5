"""Offsets of clock and pointing: by what times, turntable angles and the site may be off.

Each is what has to be added to the value that data or scenario say. They shift an observation
exactly (:func:`with_offsets`: times, turntable angles, site and lean of the lander), or a pointing
inside a compiled function (:func:`turned_by_offsets`), where the Moon turns at a constant rate
about a pole that does not wander within the clock's offset: that errs by less than 1e-3 of what
the offset itself does to the data.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import astropy.units as u
import numpy as np
from jaxtyping import Float

from lusee_bayes.core.arrays import Array, namespace
from lusee_bayes.core.errors import InputError, nearest
from lusee_bayes.instrument.moon import CYCLE_DAYS
from lusee_bayes.instrument.observation import Observation
from lusee_bayes.instrument.pointing import Pointing
from lusee_bayes.instrument.times import unannounced_leap_seconds
from lusee_bayes.instrument.windows import Windows

# of every offset, what it is
OFFSETS = {
    "clock_s": "later than the data say, in seconds",
    "clock_drift_s_per_day": "and later by so much more every day from the first sample on",
    "turntable_deg": "turntable, from East towards North, of every run",
    "lon_deg": "longitude of the site",
    "lat_deg": "latitude of the site",
    "tilt_east_deg": "lean of the lander towards East",
    "tilt_north_deg": "lean of the lander towards North",
}
CLOCK = ("clock_s", "clock_drift_s_per_day")
TILTS = ("tilt_east_deg", "tilt_north_deg")
# by which the Moon turns against the sky, as azimuths of the sky count it, in radians per hour
TURN_PER_HOUR = -2.0 * np.pi / (CYCLE_DAYS * 24.0)

Values = Mapping[str, float | Float[Array, ""]]


def offset_names(kinds: tuple[str, ...], n_runs: int) -> tuple[str, ...]:
    """Return the name of every single offset: each run has a turntable angle of its own.

    Parameters
    ----------
    kinds : tuple of str
        Keys of ``OFFSETS``.
    n_runs : int
        Number of runs.

    Returns
    -------
    tuple of str
        ``turntable_deg`` becomes turntable_0_deg, turntable_1_deg, ... where there are several.

    Raises
    ------
    InputError
        If there is no such kind of offset.
    """
    names: list[str] = []
    for kind in kinds:
        if kind not in OFFSETS:
            raise InputError(f"there is no offset '{kind}'; {nearest(kind, OFFSETS)}")
        names += _of_runs(n_runs) if kind == "turntable_deg" else [kind]
    return tuple(names)


def kind_of(name: str) -> str:
    """Return the key of ``OFFSETS`` that an offset's name belongs to."""
    return "turntable_deg" if name.startswith("turntable_") else name


def _of_runs(n_runs: int) -> list[str]:
    return ["turntable_deg"] if n_runs == 1 else [f"turntable_{run}_deg" for run in range(n_runs)]


def with_offsets(observation: Observation, values: Values) -> Observation:
    """Return the observation as it was, where the one that is said is off.

    Parameters
    ----------
    observation : Observation
        As data or a scenario say it.
    values : mapping of float
        By the names of :func:`offset_names`; what is left out is zero.

    Returns
    -------
    Observation
        With shifted times and windows, turntable angles, site and lean.
    """
    given = {name: float(value) for name, value in values.items()}
    drift = given.get("clock_drift_s_per_day", 0.0)
    stretch = 1.0 + drift / 86400.0
    late = given.get("clock_s", 0.0) + drift * observation.hours / 24.0
    with unannounced_leap_seconds():
        times = observation.times + late * u.s
    angles = zip(observation.turntable_deg, _of_runs(observation.n_runs), strict=True)
    windows = observation.windows
    if windows is not None:
        sizes = (stretch * x for x in (windows.start_s, windows.end_s, windows.live_s))
        windows = Windows(windows.sample, *sizes)
    east, north = observation.tilt_deg
    return replace(
        observation,
        lon_deg=observation.lon_deg + given.get("lon_deg", 0.0),
        lat_deg=observation.lat_deg + given.get("lat_deg", 0.0),
        times=times,
        turntable_deg=tuple(angle + given.get(name, 0.0) for angle, name in angles),
        step_s=observation.step_s * stretch,
        windows=windows,
        tilt_deg=(
            east + given.get("tilt_east_deg", 0.0),
            north + given.get("tilt_north_deg", 0.0),
        ),
    )


def turned_by_offsets(
    pointing: Pointing, hours: Float[Array, " times"], values: Values
) -> Pointing:
    """Return the pointing that offsets make of another, differentiable in them.

    Parameters
    ----------
    pointing : Pointing
        Without offsets.
    hours : (times,) array
        Since the first sample.
    values : mapping of () array
        By the names of :func:`offset_names`; what is left out is zero.

    Returns
    -------
    Pointing
        With ``turns``, and turntable and azimuth shifted.
    """
    xp = namespace(pointing, *values.values())
    given = {name: xp.asarray(value, dtype=np.float64) for name, value in values.items()}
    zero = xp.zeros(())
    late_h = given.get("clock_s", zero) / 3600.0
    drift = given.get("clock_drift_s_per_day", zero) / 86400.0
    radians = np.pi / 180.0
    # a lander further East sees the sky as it will be later
    lon = given.get("lon_deg", zero) * radians - TURN_PER_HOUR * late_h
    rest = [given.get(name, zero) * radians for name in ("lat_deg", *TILTS)]
    names = _of_runs(len(pointing.run_starts) - 1)
    turntable = xp.stack([given.get(name, zero) * radians for name in names])
    return replace(
        pointing,
        azimuth=pointing.azimuth + TURN_PER_HOUR * drift * hours,
        turntable=pointing.turntable + turntable,
        turns=xp.stack([lon, *rest]),
    )
