"""Sessions as HDF5, layouts 3 and 4."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import h5py
import numpy as np
from astropy.time import Time
from jaxtyping import Float, Float32

from lusee_bayes.instrument.flight.cubes import (
    N_PRODUCTS,
    cache_for,
    guessed_chunks,
    whole_spectra,
)
from lusee_bayes.instrument.flight.session_hdf5 import FIELDS, INTERPOLATED
from lusee_bayes.instrument.flight.session_layout import META
from lusee_bayes.instrument.flight.session_rows import SessionRows
from lusee_bayes.instrument.flight.spectrometer import N_CHANNELS
from lusee_bayes.instrument.times import unannounced_leap_seconds

# as luseepy has it
PACKED = {"compression": "gzip", "compression_opts": 1}
# by how much the clock of the telemetry is behind that of the spectrometer
TELEMETRY_BEHIND_S = 100.0
TICKS = 65536


def write_hdf5_session(
    path: Path,
    rows: SessionRows,
    blocks: Iterable[Float32[np.ndarray, "_ products _"]],
    layout: int,
) -> None:
    """Write a session.

    Parameters
    ----------
    path : Path
    rows : SessionRows
    blocks : iterable of (some rows, 16, bins) array
        As :func:`.write_session`.
    layout : {3, 4}
    """
    chunks = guessed_chunks(rows.n_rows)
    with h5py.File(path, "w", **cache_for(chunks)) as file:
        file.attrs["layout_version"] = np.int64(layout)
        file.create_group("session_invariants").attrs["software_version"] = np.int64(rows.software)
        constants = file.create_group("constants")
        constants.attrs["lun_lat_deg"] = rows.lat_deg
        constants.attrs["lun_long_deg"] = rows.lon_deg
        constants.attrs["lun_height_m"] = 0.0
        spectra = file.create_group("spectra")
        spectra.attrs["count"] = np.int64(rows.n_rows)
        number = np.arange(rows.n_rows)
        for name, values in {
            "unique_ids": number,
            "original_indices": number,
            "mjd_times": rows.mjd(),
            "raw_times" if layout == 3 else "raw_seconds": rows.raw_s,
        }.items():
            spectra.create_dataset(name, data=values, **PACKED)
        if layout == 3:
            _rest_of_3(file, rows)
        else:
            _rest_of_4(file, rows)
        shape = (rows.n_rows, N_PRODUCTS, N_CHANNELS)
        cube = spectra.create_dataset("data", shape, "f4", chunks=chunks, **PACKED)
        cube.attrs["units"] = "SDU"
        cube.attrs["representation"] = "gain_model_input_sdu"
        cube.attrs["bitslice_restored"] = np.int64(1) if layout == 3 else np.bool_(True)
        cube.attrs["bitslice_reference"] = np.int64(31)
        cube.attrs["normalization_version"] = np.int64(1)
        for first, counts in whole_spectra(path, blocks, rows.n_rows):
            cube[first : first + len(counts)] = counts


def _rest_of_3(file: h5py.File, rows: SessionRows) -> None:
    file.attrs["cdi_directory"] = ""
    file.attrs["n_items"] = np.int64(0)
    raw_s, mjd, scale, source = rows.clock_words()
    constants = file["constants"].attrs
    constants["raw_time_subtract_seconds"] = raw_s
    constants["mjd_epoch_offset_days"] = mjd
    constants["time_scale"] = scale
    constants["clock_source"] = source
    if rows.clock is not None:
        constants["clock_epoch_isot"] = _isot(rows)
    metadata = file.create_group(META)
    for name, values in rows.metadata().items():
        metadata.create_dataset(name, data=values, **PACKED)
    metadata["actual_bitslice"].attrs["applied_to_spectra"] = np.int64(1)
    metadata["actual_bitslice"].attrs["reference_bit"] = np.int64(31)
    telemetry = file.create_group(INTERPOLATED)
    for name, values in {"time": rows.raw_s, "mjd_time": rows.mjd(), **rows.telemetry}.items():
        telemetry.create_dataset(name, data=values, **PACKED)


def _rest_of_4(file: h5py.File, rows: SessionRows) -> None:
    reference = file.create_group("clock_reference")
    reference.attrs["available"] = np.bool_(rows.clock is not None)
    if rows.clock is None:
        reference.attrs["unavailable_reason"] = "not established"
    else:
        reference.attrs["format_version"] = np.uint16(1)
        reference.attrs["reference_event"] = "simulated"
        reference.attrs["clock_reference_isot"] = _isot(rows)
        reference.attrs["time_scale"] = rows.clock.scale
        reference.attrs["source"] = rows.clock.source
        reference.attrs["assumed"] = np.bool_(False)
        text = h5py.string_dtype(encoding="utf-8")
        sources = reference.create_dataset("clock_sources", (2,), text)
        sources[:] = ["spectrometer", "dcb"]
        anchors = np.array([rows.clock.raw_s, rows.clock.raw_s - TELEMETRY_BEHIND_S])
        reference.create_dataset("clock_reference_raw_seconds", data=anchors)
    file["spectra"].create_dataset("navgf", data=rows.navgf.astype(np.uint8), **PACKED)
    metadata = rows.metadata()
    # all frames that were to be averaged were, and no notch was on
    metadata["weight"] = 2 ** metadata["Navg2_shift"]
    metadata["notch"] = np.zeros(rows.n_rows, dtype=np.int64)
    fields, present = (file.create_group(f"{META}/{name}") for name in ("fields", "field_present"))
    for name, values in metadata.items():
        field = FIELDS.get(name, name)
        _write_field(fields.create_group(field), values)
        present.create_dataset(field, data=np.ones(rows.n_rows, dtype=bool), **PACKED)
    _write_telemetry(file.create_group("telemetry"), rows)


def _write_field(group: h5py.Group, values: np.ndarray) -> None:
    """A field that all spectra have, in one shape."""
    group.attrs["kind"] = "array_variants"
    group.attrs["variant_count"] = np.uint32(1)
    group.create_dataset("variant_index", data=np.zeros(len(values), dtype=np.int32), **PACKED)
    variant = group.create_group("variant_000")
    variant.attrs["numpy_dtype"] = values.dtype.str
    variant.attrs["value_shape_json"] = str(list(values.shape[1:]))
    variant.create_dataset("row_indices", data=np.arange(len(values), dtype=np.uint64), **PACKED)
    variant.create_dataset("data", data=values, **PACKED)


def _write_telemetry(group: h5py.Group, rows: SessionRows) -> None:
    """Raw telemetry, on its own clock, in seconds and ticks."""
    ticks = np.round((rows.raw_s - TELEMETRY_BEHIND_S) * TICKS).astype(np.int64)
    values: Float[np.ndarray, "rows fields"] = np.stack(list(rows.telemetry.values()), axis=1)
    names = group.create_dataset(
        "field_names", (len(rows.telemetry),), h5py.string_dtype(encoding="utf-8")
    )
    names[:] = list(rows.telemetry)
    group.create_dataset("mission_seconds", data=ticks // TICKS, **PACKED)
    group.create_dataset("lusee_subsecs", data=ticks % TICKS, **PACKED)
    group.create_dataset("values", data=values, **PACKED)


def _isot(rows: SessionRows) -> str:
    clock = rows.clock
    with unannounced_leap_seconds():
        return str(Time(clock.jd1, clock.jd2, format="jd", scale=clock.scale, precision=9).isot)
