"""What a session of luseepy's layouts holds, under the names of its HDF5 files of layout 3."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Shaped

from lusee_bayes.core.errors import InputError
from lusee_bayes.core.layouts import Attribute, Content, Layout, Unread, Variable
from lusee_bayes.instrument.flight.clock import DAY_S, SAME_S, Clock
from lusee_bayes.instrument.flight.session import TELEMETRY, Read, Session
from lusee_bayes.instrument.flight.spectrometer import LEVELS, N_CHANNELS, NO_LEVEL, PORTS
from lusee_bayes.instrument.times import scale_of

MJD_ZERO = 2400000.5
META = "spectra/metadata"
# what luseepy makes of the scale of a mission clock that nobody has established
UNKNOWN = "unknown"


def _counts(*more: int, low: float = -np.inf, high: float = np.inf, optional: bool = False):
    return Variable(("row", *more), "integer", low=low, high=high, optional=optional)


ROWS = {
    "spectra/raw_times": Variable(("row",)),
    # layout 3 alone; NaN where the clock is not known
    "spectra/mjd_times": Variable(("row",), finite=False, optional=True),
    f"{META}/Navgf": _counts(),
    f"{META}/Navg1_shift": _counts(low=0.0, high=40.0),
    f"{META}/Navg2_shift": _counts(low=0.0, high=40.0),
    f"{META}/actual_bitslice": _counts(16, low=0.0, high=31.0),
    f"{META}/adc_min": _counts(PORTS),
    f"{META}/adc_max": _counts(PORTS),
    f"{META}/adc_invalid_count_min": _counts(PORTS, low=0.0, optional=True),
    f"{META}/adc_invalid_count_max": _counts(PORTS, low=0.0, optional=True),
    f"{META}/errors": _counts(optional=True),
    # layout 4 alone has these two
    f"{META}/weight": _counts(low=0.0, optional=True),
    f"{META}/notch": _counts(low=0.0, optional=True),
    **{f"telemetry/{name}": Variable(("row",), optional=True) for name in TELEMETRY},
}
SITE = {
    "constants.lun_lat_deg": Attribute(low=-90.0, high=90.0),
    "constants.lun_long_deg": Attribute(low=-360.0, high=360.0),
    "session_invariants.software_version": Attribute("word", optional=True),
}
COUNTS = {
    "spectra/data.units": Attribute("text", choices=("SDU",)),
    "spectra/data.representation": Attribute("text", choices=("gain_model_input_sdu",)),
    "spectra/data.bitslice_restored": Attribute("boolean"),
    "spectra/data.bitslice_reference": Attribute("integer", low=31.0, high=31.0),
    "spectra/data.normalization_version": Attribute("integer", low=1.0, high=1.0),
}
CLOCK_3 = {
    "constants.raw_time_subtract_seconds": Attribute(),
    "constants.mjd_epoch_offset_days": Attribute(),
    "constants.time_scale": Attribute("text", optional=True),
}
NEWEST = 4
LAYOUT_3 = Layout("a session of lusee.ingest, layout 3", ROWS, SITE | COUNTS | CLOCK_3)
LAYOUT_4 = Layout("a session of lusee.ingest, layout 4", ROWS, SITE | COUNTS)


def require_version(path: Path, version: Any) -> int:
    """Return the version of a layout.

    Raises
    ------
    InputError
        If it is none that this package reads.
    """
    number = None if version is None else int(version)
    if number is None:
        raise InputError(
            f"{path} has no layout_version: it is no session of luseepy's lusee.ingest"
        )
    if number < 3:
        raise InputError(
            f"{path} is of layout {number}, in which bit slices are not restored; ingest the "
            "session again with luseepy, which writes layout 3 or newer"
        )
    if number > NEWEST:
        raise InputError(
            f"{path} is of layout {number}; this version reads 3 and {NEWEST}; get a newer one"
        )
    return number


def session_of(
    path: Path,
    version: int,
    kind: str,
    arrays: Mapping[str, Unread],
    values: Mapping[str, Any],
    clock: Clock | None,
    opener: Callable[[], AbstractContextManager[Read]],
    unused: Mapping[str, int] | None = None,
) -> Session:
    """Check what a file holds, and make a session of it.

    Parameters
    ----------
    path : Path
    version : int
        Of the layout: 3 or 4.
    kind : str
        HDF5 or FITS.
    arrays : mapping of str to array
        By their names in HDF5 files of layout 3, not yet read.
    values : mapping of str to object
        Attributes, as ``group.name``.
    clock : Clock or None
        What layout 4 says about the clock; layout 3 has it among the values.
    opener : callable
        Opens the spectra.
    unused : mapping of str to int, optional
        Rows of other families of data.

    Raises
    ------
    InputError
        If something is missing or not as it should be.
    """
    found = (LAYOUT_3 if version == 3 else LAYOUT_4).checked(path, arrays, values)
    if not found.values["spectra/data.bitslice_restored"]:
        raise InputError(
            f"{path}: the bit slices of spectra/data are not restored; ingest the session again "
            "with luseepy"
        )
    rows, cube = found.arrays, arrays["spectra/data"]
    n = found.sizes["row"]
    if tuple(cube.shape) != (n, 16, N_CHANNELS) or np.dtype(cube.dtype).kind != "f":
        raise InputError(
            f"{path}: spectra/data has shape {tuple(cube.shape)} and type {cube.dtype}, expected "
            f"({n}, 16, {N_CHANNELS}) real numbers"
        )
    none = np.zeros((n, PORTS), dtype=np.int64)
    shift2 = rows[f"{META}/Navg2_shift"]
    share = np.ones(n)
    if (weight := rows.get(f"{META}/weight")) is not None:
        share = np.minimum(weight / 2.0**shift2, 1.0)
    if version == 3:
        clock = _clock(path, found)
    return Session(
        path=path,
        layout=version,
        kind=kind,
        raw_s=rows["spectra/raw_times"],
        navgf=rows[f"{META}/Navgf"],
        navg_shift=rows[f"{META}/Navg1_shift"] + shift2,
        share=share,
        level=_levels(path, arrays, n),
        adc_low=rows[f"{META}/adc_min"],
        adc_high=rows[f"{META}/adc_max"],
        adc_invalid=rows.get(f"{META}/adc_invalid_count_min", none)
        + rows.get(f"{META}/adc_invalid_count_max", none),
        errors=rows.get(f"{META}/errors", none[:, 0]),
        notch=rows.get(f"{META}/notch"),
        telemetry={
            name: rows[f"telemetry/{name}"] for name in TELEMETRY if f"telemetry/{name}" in rows
        },
        clock=clock,
        lon_deg=found.values["constants.lun_long_deg"],
        lat_deg=found.values["constants.lun_lat_deg"],
        software=_version(found.values.get("session_invariants.software_version", "unknown")),
        opener=opener,
        unused=unused or {},
    )


def _version(text: str) -> str:
    """A version of the flight software as it is written: 0x307 for the number 775."""
    return f"{int(text):#x}" if text.isascii() and text.isdigit() else text


def _clock(path: Path, found: Content) -> Clock | None:
    scale = found.values.get("constants.time_scale", UNKNOWN).lower()
    mjd = found.values["constants.mjd_epoch_offset_days"]
    # luseepy writes zero where the epoch is not known
    if mjd == 0.0:
        return None
    raw_s = found.values["constants.raw_time_subtract_seconds"]
    readings = found.arrays["spectra/raw_times"]
    by_epoch = mjd + (readings - raw_s) / DAY_S
    theirs = found.arrays.get("spectra/mjd_times", by_epoch)
    off = np.flatnonzero(np.abs(theirs - by_epoch) > SAME_S / DAY_S)
    if off.size:
        k = int(off[0])
        raise InputError(
            f"{path}: mjd_times of spectrum {k} is {theirs[k]:.9g}, raw_times {readings[k]:.9g} s "
            f"with the epoch of the constants {by_epoch[k]:.9g}; ingest the session again"
        )
    if scale == UNKNOWN:
        return None
    return Clock(str(path), MJD_ZERO, mjd, scale_of(f"{path}: time_scale", scale), raw_s)


def _levels(path: Path, arrays: Mapping[str, Unread], n: int) -> Shaped[np.ndarray, "rows ports"]:
    """Gain levels, of the flight software's numbers or of letters."""
    name = f"{META}/actual_gain"
    if name not in arrays:
        raise InputError(
            f"{path} has no {name}, which says the gain of every spectrum; ingest the session "
            "again with luseepy's present version"
        )
    codes = np.asarray(arrays[name])
    if codes.dtype.kind == "S" and codes.shape == (n,):
        # FITS joins the letters of a row
        codes = np.array([list(row.decode().ljust(PORTS)) for row in codes], dtype="U1")
    if codes.shape != (n, PORTS):
        raise InputError(f"{path}: {name} has shape {codes.shape}, expected ({n}, {PORTS})")
    levels = np.full((n, PORTS), NO_LEVEL, dtype="U1")
    if codes.dtype.kind in "iu":
        for code, level in LEVELS.items():
            levels[codes == code] = level
    elif codes.dtype.kind in "SU":
        letters = codes.astype("U1")
        known = np.isin(letters, list(LEVELS.values()))
        levels[known] = letters[known]
    else:
        raise InputError(f"{path}: {name} holds {codes.dtype}, expected gain codes or letters")
    return levels
