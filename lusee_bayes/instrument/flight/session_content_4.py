"""What is written of a session in layout 4, in HDF5 and in FITS: all but the spectra."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from astropy.time import Time

from lusee_bayes.instrument.flight.clock import Clock
from lusee_bayes.instrument.flight.session_layout import META
from lusee_bayes.instrument.flight.session_layout_4 import FIELDS, TICKS
from lusee_bayes.instrument.flight.session_rows import SessionRows
from lusee_bayes.instrument.times import unannounced_leap_seconds

# by how much the clock of the telemetry is behind that of the spectrometer
TELEMETRY_BEHIND_S = 100.0
CUBE = {
    "units": "SDU",
    "representation": "gain_model_input_sdu",
    "bitslice_restored": np.bool_(True),
    "bitslice_reference": np.uint8(31),
    "normalization_version": np.uint16(1),
}
# names and types of layout 4 where it has others than layout 3
NAMES = {
    **FIELDS,
    "format": "output_format",
    "gain": "requested_gain",
    "bitslice": "requested_bitslice",
}
BYTES = ("requested_gain", "actual_gain", "requested_bitslice", "actual_bitslice")


@dataclass(frozen=True, eq=False)
class Group:
    """A group of a file.

    Attributes
    ----------
    attributes : mapping of str to object
    arrays : mapping of str to array
        Texts are arrays of str.
    """

    attributes: Mapping[str, Any] = field(default_factory=dict)
    arrays: Mapping[str, np.ndarray] = field(default_factory=dict)


def groups_of_4(rows: SessionRows) -> dict[str, Group]:
    """Return all groups by their paths, those above before those below; "" is the file itself."""
    n = rows.n_rows
    present = np.ones(n, dtype=np.bool_)
    spectra = {
        "unique_ids": np.arange(n, dtype=np.uint32),
        "original_indices": np.arange(n, dtype=np.uint64),
        "raw_seconds": rows.raw_s,
        "raw_time_valid": present,
        "mjd_times": rows.mjd() if rows.clock is not None else np.full(n, np.nan),
        "mjd_time_valid": present & (rows.clock is not None),
        "navgf": rows.navgf.astype(np.uint8),
    }
    fields = _fields(rows)
    return {
        "": Group({"layout_version": np.uint16(4)}),
        "session_invariants": Group(
            {"software_version": np.uint32(rows.software), "software_version_valid": np.bool_(True)}
        ),
        "constants": Group(
            {"lun_lat_deg": rows.lat_deg, "lun_long_deg": rows.lon_deg, "lun_height_m": 0.0}
        ),
        "clock_reference": _clock(rows.clock),
        "spectra": Group({"count": np.uint64(n)}, spectra),
        META: Group(),
        f"{META}/field_present": Group(arrays=dict.fromkeys(fields, present)),
        f"{META}/fields": Group(),
        **{
            f"{META}/fields/{path}": group
            for name, values in fields.items()
            for path, group in _variants(name, values).items()
        },
        "telemetry": _telemetry(rows),
    }


def _fields(rows: SessionRows) -> dict[str, np.ndarray]:
    """The metadata, by the names of layout 4."""
    metadata = rows.metadata()
    # all frames that were to be averaged were, and no notch was on
    metadata["weight"] = 2 ** metadata["Navg2_shift"]
    metadata["notch"] = np.zeros(rows.n_rows, dtype=np.int64)
    fields = {NAMES.get(name, name): values for name, values in metadata.items()}
    return {
        name: values.astype(np.uint8) if name in BYTES else values
        for name, values in fields.items()
    }


def _variants(name: str, values: np.ndarray) -> dict[str, Group]:
    """A field that all spectra have, in one shape."""
    number = np.arange(len(values), dtype=np.uint64)
    return {
        name: Group(
            {"kind": "array_variants", "variant_count": np.uint32(1)},
            {"variant_index": np.zeros(len(values), dtype=np.int32)},
        ),
        f"{name}/variant_000": Group(
            {
                "numpy_dtype": values.dtype.str,
                "value_shape_json": str(list(values.shape[1:])),
            },
            {"row_indices": number, "data": values},
        ),
    }


def _clock(clock: Clock | None) -> Group:
    if clock is None:
        return Group({"available": np.bool_(False), "unavailable_reason": "not established"})
    return Group(
        {
            "available": np.bool_(True),
            "format_version": np.uint16(1),
            "reference_event": "simulated",
            "clock_reference_isot": isot(clock),
            "time_scale": clock.scale,
            "source": clock.source,
            "assumed": np.bool_(False),
        },
        {
            "clock_sources": np.array(["dcb", "spectrometer"]),
            "clock_reference_raw_seconds": np.array(
                [clock.raw_s - TELEMETRY_BEHIND_S, clock.raw_s]
            ),
        },
    )


def _telemetry(rows: SessionRows) -> Group:
    """Raw telemetry, on its own clock, in seconds and ticks."""
    ticks = np.round((rows.raw_s - TELEMETRY_BEHIND_S) * TICKS).astype(np.int64)
    values = np.stack(list(rows.telemetry.values()), axis=1)
    return Group(
        {"source_kind": "simulated"},
        {
            "field_names": np.array(list(rows.telemetry)),
            "mission_seconds": (ticks // TICKS).astype(np.uint32),
            "lusee_subsecs": (ticks % TICKS).astype(np.uint16),
            "values": values,
            "valid": np.isfinite(values),
        },
    )


def isot(clock: Clock) -> str:
    """Return the reference time of a clock as text, in its own scale."""
    with unannounced_leap_seconds():
        return str(Time(clock.jd1, clock.jd2, format="jd", scale=clock.scale, precision=9).isot)
