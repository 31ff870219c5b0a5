"""Sessions of ``lusee.ingest`` in HDF5, layouts 3 and 4.

Layout 4 has row-aligned metadata as a union of fields (``metadata/fields/NAME/variant_000/data``),
raw telemetry on its own clock, and a clock reference in place of an MJD offset; it is brought to
the names of layout 3.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from astropy.time import Time
from jaxtyping import Float, Shaped

from lusee_bayes.core.errors import InputError
from lusee_bayes.core.hdf5_probe import require_readable_hdf5
from lusee_bayes.core.layouts import Unread
from lusee_bayes.core.reading import reading
from lusee_bayes.instrument.flight.clock import SCALES, Clock
from lusee_bayes.instrument.flight.cubes import cache_for
from lusee_bayes.instrument.flight.session import TELEMETRY, Read, Session
from lusee_bayes.instrument.flight.session_layout import META, at_rows, session_of
from lusee_bayes.instrument.times import unannounced_leap_seconds

NEWEST = 4
INTERPOLATED = "spectra_interpolated_telemetry"
# names of layout 4 for those of layout 3
FIELDS = {
    "Navgf": "navgf",
    "Navg1_shift": "navg1_shift",
    "Navg2_shift": "navg2_shift",
    **{
        name: name
        for name in (
            "actual_bitslice",
            "actual_gain",
            "adc_min",
            "adc_max",
            "adc_invalid_count_min",
            "adc_invalid_count_max",
            "errors",
            "weight",
            "notch",
        )
    },
}
WHAT = "a session of lusee.ingest in HDF5"


def read_hdf5_session(path: Path) -> Session:
    """Read everything of a session but its spectra.

    Parameters
    ----------
    path : Path

    Raises
    ------
    InputError
        For a file that is damaged, of another kind or of another version, and for whatever it
        lacks.
    """
    with reading(path, WHAT):
        require_readable_hdf5(path)
        with h5py.File(path) as file:
            version = require_version(path, file.attrs.get("layout_version"))
            if "spectra" not in file or "data" not in file["spectra"]:
                raise InputError(
                    f"{path} has no spectra/data: the session holds no spectra (it has "
                    f"{', '.join(file) or 'nothing'})"
                )
            arrays, values = _common(file)
            clock = None
            if version == 3:
                arrays |= _telemetry_3(path, file)
            else:
                arrays |= _metadata_4(path, file)
                clock = _clock_4(path, file)
                arrays |= _telemetry_4(path, file, clock)
                rename = {"spectra/raw_seconds": "spectra/raw_times"}
                arrays |= {new: arrays[old] for old, new in rename.items() if old in arrays}
            return session_of(path, version, "HDF5", arrays, values, clock, _opener(path))


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


def _opener(path: Path) -> Callable[[], AbstractContextManager[Read]]:
    @contextmanager
    def opened() -> Iterator[Read]:
        with h5py.File(path) as file:
            cache = cache_for(file["spectra/data"].chunks)
        with h5py.File(path, **cache) as file:
            cube = file["spectra/data"]

            def read(first: int, last: int) -> Shaped[np.ndarray, "rows products channels"]:
                return np.asarray(cube[first:last], dtype=np.float32)

            yield read

    return opened


def _common(file: h5py.File) -> tuple[dict[str, Unread], dict[str, Any]]:
    """Arrays by their paths, and attributes as group.name."""
    arrays: dict[str, Unread] = {}
    for group in ("spectra", META):
        if group in file:
            arrays |= {
                f"{group}/{name}": item
                for name, item in file[group].items()
                if isinstance(item, h5py.Dataset)
            }
    values = {
        f"{name}.{key}": value
        for name in ("constants", "session_invariants", "spectra/data")
        if name in file
        for key, value in file[name].attrs.items()
    }
    return arrays, values


def _telemetry_3(path: Path, file: h5py.File) -> dict[str, Unread]:
    """Telemetry at the times of the spectra, as the file has it."""
    if INTERPOLATED not in file:
        return {}
    group = file[INTERPOLATED]
    if "time" in group and "raw_times" in file["spectra"]:
        theirs, ours = np.asarray(group["time"]), np.asarray(file["spectra/raw_times"])
        if theirs.shape != ours.shape or not np.array_equal(theirs, ours):
            raise InputError(f"{path}: {INTERPOLATED}/time are not the times of the spectra")
    return {f"telemetry/{name}": group[name] for name in TELEMETRY if name in group}


def _metadata_4(path: Path, file: h5py.File) -> dict[str, Unread]:
    """Fields that all rows have, in one shape."""
    found: dict[str, Unread] = {}
    if f"{META}/fields" not in file:
        return found
    fields, n = file[f"{META}/fields"], file["spectra/data"].shape[0]
    for ours, theirs in FIELDS.items():
        if theirs not in fields or "variant_000" not in fields[theirs]:
            continue
        variant = fields[theirs]["variant_000"]
        if variant["data"].shape[0] != n:
            raise InputError(
                f"{path}: {META}/fields/{theirs} is there for {variant['data'].shape[0]} of {n} "
                "spectra, or has several shapes; ingest the session again"
            )
        found[f"{META}/{ours}"] = variant["data"]
    if "navgf" in file["spectra"]:
        found[f"{META}/Navgf"] = file["spectra/navgf"]
    return found


def _clock_4(path: Path, file: h5py.File) -> Clock | None:
    if "clock_reference" not in file or not bool(file["clock_reference"].attrs.get("available")):
        return None
    group = file["clock_reference"]
    scale, text = (str(group.attrs[name]) for name in ("time_scale", "clock_reference_isot"))
    if scale not in SCALES:
        raise InputError(f"{path}: time_scale is '{scale}'; expected one of {', '.join(SCALES)}")
    raw_s = _anchors(file).get("spectrometer")
    if raw_s is None:
        return None
    with unannounced_leap_seconds():
        time = Time(text, format="isot", scale=scale)
    return Clock(str(path), float(time.jd1), float(time.jd2), scale, raw_s)


def _anchors(file: h5py.File) -> dict[str, float]:
    """What each clock showed at the reference."""
    group = file["clock_reference"]
    if "clock_sources" not in group:
        return {}
    names = group["clock_sources"].asstr()[()]
    return dict(zip(names, np.asarray(group["clock_reference_raw_seconds"]).tolist(), strict=True))


def _telemetry_4(path: Path, file: h5py.File, clock: Clock | None) -> dict[str, Unread]:
    """Telemetry at the times of the spectra, where both clocks have a reference."""
    if "telemetry" not in file or clock is None or "dcb" not in _anchors(file):
        return {}
    group = file["telemetry"]
    names = list(group["field_names"].asstr()[()])
    ticks = np.asarray(group["lusee_subsecs"]) / 65536.0
    times_s = np.asarray(group["mission_seconds"]) + ticks - _anchors(file)["dcb"] + clock.raw_s
    values: Float[np.ndarray, "times fields"] = np.asarray(group["values"])
    raw_s = np.asarray(file["spectra/raw_seconds"])
    return {
        f"telemetry/{name}": at_rows(
            f"{path}: telemetry {name}", raw_s, times_s, values[:, names.index(name)]
        )
        for name in TELEMETRY
        if name in names
    }
