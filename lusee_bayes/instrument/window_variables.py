"""Windows of samples in netCDF files, and what files without them say of their times.

``time_bounds`` is that of the CF conventions, for people and other software, and ``live_time`` goes
with it. The pieces are exact: seconds from the time of their sample. Instants are declared by the
attribute ``window``. A file with none of these does not say what its times are.
"""

from __future__ import annotations

from typing import Any

import astropy.units as u
import numpy as np
from astropy.time import Time

from lusee_bayes.core.errors import InputError
from lusee_bayes.core.layouts import Attribute, Content, Variable
from lusee_bayes.instrument.observation import Observation
from lusee_bayes.instrument.times import unannounced_leap_seconds, utc_of_datetimes
from lusee_bayes.instrument.timestamps import bounded
from lusee_bayes.instrument.windows import Windows

PIECES = ("piece_sample", "piece_start_s", "piece_end_s", "piece_live_s")
VARIABLES = {
    "time_bounds": Variable(("time", 2), "time", optional=True),
    "live_time": Variable(("time",), optional=True),
    "piece_sample": Variable(("piece",), "integer", low=0.0, optional=True),
    **{name: Variable(("piece",), optional=True) for name in PIECES[1:]},
}
ATTRIBUTES = {"window": Attribute("text", choices=("mean", "instant"), optional=True)}
# times for people are written to the millisecond
EYE = {"units": "milliseconds since 1970-01-01", "calendar": "proleptic_gregorian"}
ENCODING = EYE | {"dtype": "int64"}
EYE_S = 0.01


def coordinate(observation: Observation) -> tuple[Any, ...]:
    """Return the coordinate ``time`` of a Dataset, for the reader's eye."""
    attrs = {} if observation.windows is None else {"bounds": "time_bounds"}
    return ("time",), _datetimes(observation.times), attrs, ENCODING


def variables(observation: Observation) -> dict[str, tuple[Any, ...]]:
    """Return the variables of a Dataset that hold the windows of an observation, if it has any."""
    windows = observation.windows
    if windows is None:
        return {}
    with unannounced_leap_seconds():
        bounds = observation.times[:, None] + windows.bounds_s * u.s
    values = (windows.sample, windows.start_s, windows.end_s, windows.live_s)
    return {
        "time_bounds": (("time", "bounds"), _datetimes(bounds), {}, ENCODING),
        "live_time": (("time",), windows.live_per_sample_s, {"units": "s"}),
        "piece_sample": (("piece",), values[0]),
        **{
            name: (("piece",), value, {"units": "s"})
            for name, value in zip(PIECES[1:], values[1:], strict=True)
        },
    }


def _datetimes(times: Time) -> np.ndarray:
    return times.isot.astype("datetime64[ms]")


def attributes(observation: Observation) -> dict[str, str]:
    """Return the attribute of a file that says whether its samples are means or instants."""
    return {"window": "instant" if observation.windows is None else "mean"}


def read_windows(found: Content, times: Time) -> tuple[Time, Windows | None, bool]:
    """Return what a file says of the windows of its samples.

    Parameters
    ----------
    found : Content
        Of a layout with ``VARIABLES`` and ``ATTRIBUTES``, and an attribute ``step_s``.
    times : (times,) Time
        Of its samples.

    Returns
    -------
    Time
        The middles of the windows; the times as they are where there are none.
    Windows or None
    bool
        Whether the file says what its times are.

    Raises
    ------
    InputError
        For variables that belong together and are not all there, or contradict each other, and
        as :class:`.Windows`.
    """
    here, said = found.arrays, found.values.get("window")
    pieces = [name for name in PIECES if name in here]
    given = [*pieces, *(name for name in ("time_bounds", "live_time") if name in here)]
    if said == "instant" and given:
        raise InputError(
            f"the attribute window says that the samples are instants, and {given[0]} gives "
            "them windows; leave out one of them"
        )
    if pieces and len(pieces) < len(PIECES):
        lost = next(name for name in PIECES if name not in here)
        raise InputError(f"there is {pieces[0]}, but no {lost}; pieces of windows need both")
    if pieces:
        windows = Windows(*(here[name] for name in PIECES))
        if "time_bounds" in here:
            _require_same(windows, times, here["time_bounds"])
        return times, windows, True
    if "time_bounds" in here:
        bounds = utc_of_datetimes(here["time_bounds"])
        live_s = here.get("live_time")
        middles, _, windows = bounded(times, bounds, found.values["step_s"], live_s)
        return middles, windows, True
    if given or said == "mean":
        what = "live_time" if given else "the attribute window = 'mean'"
        raise InputError(
            f"there is {what}, but no time_bounds; add the start and the end of every sample"
        )
    return times, None, said == "instant"


def _require_same(windows: Windows, times: Time, there: np.ndarray) -> None:
    bounds = utc_of_datetimes(there)
    with unannounced_leap_seconds():
        seconds = (bounds - times[:, None]).to_value(u.s)
    if windows.n_samples != len(times):
        return  # an Observation says so
    off = np.abs(seconds - windows.bounds_s).max(axis=1)
    if (off > EYE_S).any():
        first = int(np.argmax(off > EYE_S))
        raise InputError(
            f"time_bounds and the pieces of sample {first} differ by {off[first]:g} s; change "
            "both, or leave out the variables of the pieces"
        )
