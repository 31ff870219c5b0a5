"""Files of sessions: read in every layout, written in layout 3, piece by piece.

Written files have all entries that :func:`read_session` and luseepy read, but none of the other
data of luseepy's sessions, such as waveforms and housekeeping packets.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from astropy.io import fits
from astropy.table import Column, Table
from jaxtyping import Float, Float32, Int

from lusee_bayes.core import files, formats
from lusee_bayes.core.arrays import Rows
from lusee_bayes.core.errors import InputError
from lusee_bayes.core.reading import reading, require_file
from lusee_bayes.flight.clock import DAY_S, MJD_ZERO
from lusee_bayes.flight.layout_3 import INTERPOLATED, UNKNOWN, session_of_fits, session_of_hdf5
from lusee_bayes.flight.layout_4 import session_of_4
from lusee_bayes.flight.session import CODES, META, N_CHANNELS, N_PRODUCTS, Recorded, Session

Counts = Float32[np.ndarray, "_ products _"]
Blocks = Iterable[Counts]
HDF5, FITS = (f"a session of lusee.ingest in {kind}" for kind in ("HDF5", "FITS"))
NEWEST = 4


def read_session(path: str | Path) -> Session:
    """Read a session except its spectra, which stay in the file.

    Parameters
    ----------
    path : str or Path
        HDF5 of layout 3 or 4, or FITS of layout 3.

    Raises
    ------
    InputError
        For a file that is missing, damaged, incomplete, or of another kind or version.
    """
    path = require_file(path, "a session")
    if formats.is_fits(path):
        with formats.opened(path, FITS) as hdus:
            if _version_of(path, hdus[0].header.get("LAYOUTV")) == 4:
                raise InputError(
                    f"{path} is of layout 4 in FITS, but this version reads layout 4 only in HDF5; "
                    "ingest the session again with luseepy, as HDF5"
                )
            return session_of_fits(path, hdus)
    with reading(path, HDF5):
        if not h5py.is_hdf5(path):
            raise InputError(f"{path} is neither HDF5 nor FITS; expected a session of lusee.ingest")
        formats.require_readable_hdf5(path)
        with h5py.File(path) as file:
            version = _version_of(path, file.attrs.get("layout_version"))
            return (session_of_4 if version == 4 else session_of_hdf5)(path, file)


def _version_of(path: Path, version: Any) -> int:
    """Return the version of a layout; InputError if this package does not read it."""
    if version is None:
        wrong = f"{path} has no layout_version; expected a session of luseepy's lusee.ingest"
        raise InputError(wrong)
    if (number := int(version)) < 3:
        raise InputError(
            f"{path} is of layout {number}, without restored bit slices; ingest the session again "
            "with luseepy, which writes layout 3 or newer"
        )
    if number > NEWEST:
        why = f"{path} is of layout {number}; this version reads 3 and {NEWEST}; update lusee_bayes"
        raise InputError(why)
    return number


def whole_spectra(path: Path, blocks: Blocks, n_rows: int) -> Iterator[tuple[int, Counts]]:
    """Yield the first row and the counts of every block, with all 2048 channels.

    Raises
    ------
    InputError
        If the blocks do not have as many rows as the session.
    """
    first = 0
    for block in blocks:
        n, products, bins = block.shape
        full = np.full((n, products, N_CHANNELS), np.nan, dtype=np.float32)
        full[..., :bins] = block
        yield first, full
        first += n
    if first != n_rows:
        raise InputError(f"{path}: counts of {first} spectra for {n_rows} rows")


# logarithm to base 2 of the frames averaged by the hardware; software does the rest
NAVG1_SHIFT = 14
# mean of an ADC's samples without signal
ADC_MEAN = 0.3


@dataclass(frozen=True, eq=False, kw_only=True)
class SessionRows(Recorded):
    """A session without its spectra; the gain table has all its gains.

    Attributes
    ----------
    bitslice : (rows, 16) array of int
        Counts are multiples of 2^(bitslice - 31).
    adc_rms : (rows, ports) array
    software : int
        Version of the flight software.
    """

    bitslice: Int[np.ndarray, "rows products"]
    adc_rms: Float[np.ndarray, "rows ports"]
    software: int

    def metadata(self) -> dict[str, np.ndarray]:
        """Return the fields of every spectrum, by the names of layout 3."""
        first = np.minimum(self.navg_shift, NAVG1_SHIFT)
        gain = np.vectorize(CODES.__getitem__, otypes=[np.int64])(self.level)
        return {
            "Navg1_shift": first,
            "Navg2_shift": self.navg_shift - first,
            "Navgf": self.navgf,
            **dict.fromkeys(("format", "errors"), np.zeros(self.n_rows, dtype=np.int64)),
            **dict.fromkeys(("actual_bitslice", "bitslice"), self.bitslice),
            **dict.fromkeys(("actual_gain", "gain"), gain),
            "adc_min": self.adc_low,
            "adc_max": self.adc_high,
            "adc_mean": np.full_like(self.adc_rms, ADC_MEAN),
            "adc_rms": self.adc_rms,
            "adc_invalid_count_min": self.adc_invalid,
            "adc_invalid_count_max": np.zeros_like(self.adc_invalid),
        }

    def clock_words(self) -> tuple[float, float, str, str]:
        """Return the clock in the terms of layout 3.

        Returns
        -------
        raw_s, mjd : float
            A reading, and its MJD; zero if it is unknown.
        scale, source : str
        """
        if self.clock is None:
            return 0.0, 0.0, UNKNOWN, UNKNOWN
        mjd = (self.clock.jd1 - MJD_ZERO) + self.clock.jd2
        return self.clock.raw_s, mjd, self.clock.scale, "mission_counter"

    def mjd(self) -> Rows:
        """Return the column of MJD that luseepy computes from the clock."""
        raw_s, mjd, _, _ = self.clock_words()
        return (self.raw_s - raw_s) / DAY_S + mjd


def write_session(
    path: str | Path, rows: SessionRows, blocks: Blocks, *, kind: str = "hdf5"
) -> Path:
    """Write a session, complete or not at all.

    Parameters
    ----------
    path : str or Path
    rows : SessionRows
    blocks : iterable of (some rows, 16, bins) array
        Counts, in the spectrometer's order of products; in blocks, so that they are never all in
        memory. Fewer bins than 2048 are filled up with NaN.
    kind : {"hdf5", "fits"}

    Raises
    ------
    InputError
        If the blocks do not match the rows, or the file cannot be written.
    """
    write = {"hdf5": _write_session_hdf5, "fits": _write_session_fits}[kind]
    path = files.user_path(path)
    with files.replacing(path) as unfinished:
        write(unfinished, rows, blocks)
    return path


def _write_session_fits(path: Path, rows: SessionRows, blocks: Blocks) -> None:
    primary = fits.PrimaryHDU()
    primary.header.update({"LAYOUTV": 3, "ORIGIN": "lusee_bayes"})
    invariants, constants = (fits.ImageHDU(name=name) for name in ("SESSION_INV", "CONSTANTS"))
    invariants.header["SW_VERS"] = rows.software
    site = {"LUN_LAT": rows.lat_deg, "LUN_LON": rows.lon_deg, "LUN_HGT": 0.0}
    raw_s, mjd, scale, source = rows.clock_words()
    clock = {"RAWSHFT": raw_s, "MJDOFF": mjd, "TIMESYS": scale.upper(), "CLKSRC": source}
    constants.header.update(site | clock)
    fits.HDUList([primary, invariants, constants]).writeto(path)
    n, shape = rows.n_rows, (rows.n_rows, N_PRODUCTS, N_CHANNELS)
    header = fits.ImageHDU(np.broadcast_to(np.float32(0.0), shape), name="SPECTRA").header
    header.update({"NTIME": n, "NPROD": N_PRODUCTS, "NCHAN": N_CHANNELS})
    header.update({"BUNIT": "SDU", "BITSREST": True, "BITSREF": 31, "NORMVER": 1})
    header["HIERARCH REPRESENTATION"] = "gain_model_input_sdu"
    with fits.StreamingHDU(str(path), header) as cube:
        for _, counts in whole_spectra(path, blocks, rows.n_rows):
            cube.write(counts)
    with fits.open(path, mode="append") as hdus:
        number = np.arange(rows.n_rows)
        raw_s, mjd = Column(rows.raw_s, unit="s"), Column(rows.mjd(), unit="d")
        times = {"RAW_TIME": raw_s, "MJD_TIME": mjd}
        identity = {"UNIQUE_ID": number, **times, "ORIG_IDX": number}
        tables = {"SPECTRA_TIMES": identity, "SPECTRA_META": rows.metadata()}
        for name, columns in (tables | {"SPEC_INTERP": {**times, **rows.telemetry}}).items():
            hdus.append(fits.BinTableHDU(Table(columns), name=name))


# as in luseepy
PACKED = {"compression": "gzip", "compression_opts": 1}

# attributes of the spectra
CUBE = {
    "units": "SDU",
    "representation": "gain_model_input_sdu",
    "bitslice_restored": np.int64(1),
    "bitslice_reference": np.int64(31),
    "normalization_version": np.int64(1),
}


def _write_session_hdf5(path: Path, rows: SessionRows, blocks: Blocks) -> None:
    with formats.hdf5_file(path) as target, h5py.File(target, "w") as file:
        _write_all_but_spectra(file, rows)
        shape = (rows.n_rows, N_PRODUCTS, N_CHANNELS)
        cube = file.create_dataset("spectra/data", shape, "f4", chunks=(1, *shape[1:]), **PACKED)
        cube.attrs.update(CUBE)
        for first, counts in whole_spectra(path, blocks, rows.n_rows):
            cube[first : first + len(counts)] = counts


def _write_all_but_spectra(file: h5py.File, rows: SessionRows) -> None:
    file.attrs.update(layout_version=np.int64(3), cdi_directory="", n_items=np.int64(0))
    file.create_group("session_invariants").attrs["software_version"] = np.int64(rows.software)
    raw_s, mjd, scale, source = rows.clock_words()
    constants = file.create_group("constants").attrs
    constants.update(lun_lat_deg=rows.lat_deg, lun_long_deg=rows.lon_deg, lun_height_m=0.0)
    constants.update(raw_time_subtract_seconds=raw_s, mjd_epoch_offset_days=mjd)
    constants.update(time_scale=scale, clock_source=source)
    if rows.clock is not None:
        constants["clock_epoch_isot"] = rows.clock.isot
    number, raw_s, mjd = np.arange(rows.n_rows), rows.raw_s, rows.mjd()
    times = {"unique_ids": number, "original_indices": number, "mjd_times": mjd, "raw_times": raw_s}
    telemetry = {"time": raw_s, "mjd_time": mjd, **rows.telemetry}
    for group, arrays in {"spectra": times, META: rows.metadata(), INTERPOLATED: telemetry}.items():
        for name, values in arrays.items():
            file.create_dataset(f"{group}/{name}", data=values, **PACKED)
    file["spectra"].attrs["count"] = np.int64(rows.n_rows)
    bitslice = {"applied_to_spectra": np.int64(1), "reference_bit": np.int64(31)}
    file[f"{META}/actual_bitslice"].attrs.update(bitslice)
