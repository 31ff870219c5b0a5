"""Sessions as HDF5."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import h5py
import numpy as np
from jaxtyping import Float32

from lusee_bayes.instrument.flight.cubes import (
    N_PRODUCTS,
    cache_for,
    guessed_chunks,
    whole_spectra,
)
from lusee_bayes.instrument.flight.session_hdf5 import INTERPOLATED
from lusee_bayes.instrument.flight.session_layout import META
from lusee_bayes.instrument.flight.session_rows import SessionRows
from lusee_bayes.instrument.flight.spectrometer import N_CHANNELS

# as luseepy has it
PACKED = {"compression": "gzip", "compression_opts": 1}

# what the spectra say of themselves
CUBE = {
    "units": "SDU",
    "representation": "gain_model_input_sdu",
    "bitslice_restored": np.int64(1),
    "bitslice_reference": np.int64(31),
    "normalization_version": np.int64(1),
}


def write_hdf5_session(
    path: Path, rows: SessionRows, blocks: Iterable[Float32[np.ndarray, "_ products _"]]
) -> None:
    """Write a session.

    Parameters
    ----------
    path : Path
    rows : SessionRows
    blocks : iterable of (some rows, 16, bins) array
        As :func:`.write_session`.
    """
    chunks = guessed_chunks(rows.n_rows)
    with h5py.File(path, "w", **cache_for(chunks)) as file:
        _write_all_but_spectra(file, rows)
        shape = (rows.n_rows, N_PRODUCTS, N_CHANNELS)
        cube = file.create_dataset("spectra/data", shape, "f4", chunks=chunks, **PACKED)
        cube.attrs.update(CUBE)
        for first, counts in whole_spectra(path, blocks, rows.n_rows):
            cube[first : first + len(counts)] = counts


def _write_all_but_spectra(file: h5py.File, rows: SessionRows) -> None:
    file.attrs["layout_version"] = np.int64(3)
    file.create_group("session_invariants").attrs["software_version"] = np.int64(rows.software)
    file.attrs["cdi_directory"] = ""
    file.attrs["n_items"] = np.int64(0)
    raw_s, mjd, scale, source = rows.clock_words()
    constants = file.create_group("constants").attrs
    constants["lun_lat_deg"] = rows.lat_deg
    constants["lun_long_deg"] = rows.lon_deg
    constants["lun_height_m"] = 0.0
    constants["raw_time_subtract_seconds"] = raw_s
    constants["mjd_epoch_offset_days"] = mjd
    constants["time_scale"] = scale
    constants["clock_source"] = source
    if rows.clock is not None:
        constants["clock_epoch_isot"] = rows.clock.isot
    spectra = file.create_group("spectra")
    spectra.attrs["count"] = np.int64(rows.n_rows)
    number = np.arange(rows.n_rows)
    times = {"mjd_times": rows.mjd(), "raw_times": rows.raw_s}
    for name, values in {"unique_ids": number, "original_indices": number, **times}.items():
        spectra.create_dataset(name, data=values, **PACKED)
    metadata = file.create_group(META)
    for name, values in rows.metadata().items():
        metadata.create_dataset(name, data=values, **PACKED)
    metadata["actual_bitslice"].attrs["applied_to_spectra"] = np.int64(1)
    metadata["actual_bitslice"].attrs["reference_bit"] = np.int64(31)
    telemetry = file.create_group(INTERPOLATED)
    for name, values in {"time": rows.raw_s, "mjd_time": rows.mjd(), **rows.telemetry}.items():
        telemetry.create_dataset(name, data=values, **PACKED)
