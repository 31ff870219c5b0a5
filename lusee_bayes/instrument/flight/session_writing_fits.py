"""Sessions as FITS."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np
from astropy.io import fits
from jaxtyping import Float32

from lusee_bayes.instrument.flight.cubes import N_PRODUCTS, whole_spectra
from lusee_bayes.instrument.flight.session_rows import SessionRows
from lusee_bayes.instrument.flight.spectrometer import N_CHANNELS

# files of FITS are made of records of this length
RECORD = 2880
# letters of FITS for types of columns
FORMATS = {"i": "K", "f": "D"}


def write_fits_session(
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
    _before(rows).writeto(path)
    with path.open("ab") as file:
        file.write(_cube_header(rows.n_rows).tostring().encode("ascii"))
        size = 0
        for _, counts in whole_spectra(path, blocks, rows.n_rows):
            size += file.write(counts.astype(">f4").tobytes())
        file.write(b"\0" * (-size % RECORD))
    with fits.open(path, mode="append") as hdus:
        number = np.arange(rows.n_rows)
        times = {"RAW_TIME": rows.raw_s, "MJD_TIME": rows.mjd()}
        identity = {"UNIQUE_ID": number, **times, "ORIG_IDX": number}
        hdus.append(_table("SPECTRA_TIMES", identity))
        hdus.append(_table("SPECTRA_META", rows.metadata()))
        hdus.append(_table("SPEC_INTERP", {**times, **rows.telemetry}))


def _before(rows: SessionRows) -> fits.HDUList:
    """All that comes before the spectra."""
    primary = fits.PrimaryHDU()
    primary.header["LAYOUTV"] = 3
    primary.header["ORIGIN"] = "lusee_bayes"
    invariants = fits.ImageHDU(name="SESSION_INV")
    invariants.header["SW_VERS"] = rows.software
    raw_s, mjd, scale, source = rows.clock_words()
    constants = fits.ImageHDU(name="CONSTANTS")
    constants.header.update(
        {
            "LUN_LAT": rows.lat_deg,
            "LUN_LON": rows.lon_deg,
            "LUN_HGT": 0.0,
            "RAWSHFT": raw_s,
            "MJDOFF": mjd,
            "TIMESYS": scale.upper(),
            "CLKSRC": source,
        }
    )
    return fits.HDUList([primary, invariants, constants])


def _cube_header(n_rows: int) -> fits.Header:
    header = fits.Header()
    header["XTENSION"] = "IMAGE"
    header["BITPIX"] = -32
    header["NAXIS"] = 3
    for axis, length in enumerate((N_CHANNELS, N_PRODUCTS, n_rows), start=1):
        header[f"NAXIS{axis}"] = length
    header["PCOUNT"] = 0
    header["GCOUNT"] = 1
    header["EXTNAME"] = "SPECTRA"
    header["NTIME"] = n_rows
    header["NPROD"] = N_PRODUCTS
    header["NCHAN"] = N_CHANNELS
    header["BUNIT"] = "SDU"
    header["BITSREST"] = True
    header["BITSREF"] = 31
    header["NORMVER"] = 1
    header["HIERARCH REPRESENTATION"] = "gain_model_input_sdu"
    return header


def _table(name: str, columns: Mapping[str, np.ndarray]) -> fits.BinTableHDU:
    units = {"RAW_TIME": "s", "MJD_TIME": "d"}
    return fits.BinTableHDU.from_columns(
        [
            fits.Column(
                key,
                f"{values[0].size}{FORMATS[values.dtype.kind]}",
                unit=units.get(key),
                array=values,
            )
            for key, values in columns.items()
        ],
        name=name,
    )
