"""Waterfalls of luseepy's four-port simulator: covariances at the receivers' inputs, in V^2/Hz.

FITS version 3: image ``data`` (time, product, frequency); ``freq`` in MHz; ``time`` (JD1, JD2) in
the scale TIMESYS; table ``products`` with a column ``label``; U (frequency, port, port), the
covariance that an enclosure of 1 K makes, as ``blackbody_normalization``. Header: LUN_LAT_DEG,
LUN_LONG_DEG, DELTAT_SEC, TMOON_K, TANT_K. Divided by sqrt(U_aa U_bb), visibilities are in K.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from astropy.io import fits
from astropy.time import STANDARD_TIME_SCALES, Time
from jaxtyping import Float

from lusee_bayes.core.errors import InputError
from lusee_bayes.core.fits_files import read_images
from lusee_bayes.instrument.observation import Observation, unannounced_leap_seconds
from lusee_bayes.instrument.products import N_ANTENNAS, all_products, labels
from lusee_bayes.instrument.waterfalls.waterfall import Waterfall

IMAGES = ("data", "freq", "time", "products", "blackbody_normalization_real")
KEYS = ("DELTAT_SEC", "LUN_LAT_DEG", "LUN_LONG_DEG", "TMOON_K")
UNIT = "V^2/Hz"


def read_four_port(path: Path) -> Waterfall:
    """Read a waterfall of luseepy's four-port simulator.

    Parameters
    ----------
    path : Path

    Returns
    -------
    Waterfall

    Raises
    ------
    InputError
        For a truncated file, a missing image or header entry, shapes or a unit that do not fit,
        unknown products, or times that do not grow.
    """
    images, header = read_images(path, IMAGES, "a waterfall of luseepy's four-port simulator")
    missing = [key for key in KEYS if key not in header]
    if missing:
        raise InputError(f"{path}: the header has no {missing[0]}; expected {', '.join(KEYS)}")
    unit = str(header.get("BUNIT", "absent")).strip()
    if unit != UNIT:
        raise InputError(f"{path}: the unit (BUNIT) of data is {unit}, expected {UNIT}")
    data, frequencies = images["data"].astype(np.float64), images["freq"].astype(np.float64)
    places = _places(path, images["products"])
    times = images["time"].astype(np.float64)
    if data.shape != (len(times), len(places), len(frequencies)):
        raise InputError(
            f"{path}: data has shape {data.shape}, expected {len(times)} times, {len(places)} "
            f"products and {len(frequencies)} channels"
        )
    enclosure = images["blackbody_normalization_real"].astype(np.float64)
    if enclosure.shape != (len(frequencies), N_ANTENNAS, N_ANTENNAS):
        raise InputError(
            f"{path}: blackbody_normalization_real has shape {enclosure.shape}, expected "
            f"{(len(frequencies), N_ANTENNAS, N_ANTENNAS)}"
        )
    per_kelvin = enclosure.diagonal(axis1=1, axis2=2)
    root = np.sqrt(per_kelvin)
    grid = np.full((len(all_products()), len(times), len(frequencies)), np.nan)
    for column, place in enumerate(places):
        product = all_products()[place]
        grid[place] = data[:, column] / (root[:, product.i] * root[:, product.j])
    return Waterfall(
        str(path),
        grid,
        frequencies,
        _observation(path, header, times),
        per_kelvin,
        float(header["TMOON_K"]),
        float(header.get("TANT_K", 0.0)),
    )


def _places(path: Path, products: np.ndarray) -> list[int]:
    """The number of the product in each column, in the package's order."""
    if products.dtype.names is None or "label" not in products.dtype.names:
        raise InputError(f"{path}: products has no column 'label'")
    named = [str(label).strip() for label in np.asarray(products["label"]).astype(str)]
    known = labels()
    for label in named:
        if label not in known:
            raise InputError(
                f"{path}: there is no product '{label}'; expected some of {', '.join(known)}"
            )
    if len(set(named)) < len(named):
        raise InputError(f"{path}: products names the same product twice")
    return [known.index(label) for label in named]


def _observation(path: Path, header: fits.Header, times: Float[np.ndarray, "..."]) -> Observation:
    if times.ndim != 2 or times.shape[1] != 2:
        raise InputError(f"{path}: time has shape {times.shape}, expected (times, 2): JD1 and JD2")
    scale = str(header.get("TIMESYS", "UTC")).strip().lower()
    if scale not in STANDARD_TIME_SCALES:
        known = ", ".join(s.upper() for s in STANDARD_TIME_SCALES)
        raise InputError(f"{path}: TIMESYS is {scale.upper()}; expected one of {known}")
    try:
        with unannounced_leap_seconds():
            utc = Time(times[:, 0], times[:, 1], format="jd", scale=scale).utc
        return Observation(
            float(header["LUN_LONG_DEG"]),
            float(header["LUN_LAT_DEG"]),
            utc,
            np.zeros(len(times), dtype=int),
            (0.0,),
            float(header["DELTAT_SEC"]),
        )
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
