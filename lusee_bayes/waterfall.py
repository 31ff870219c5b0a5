"""Waterfalls of luseepy's simulator: visibilities in K for all times, products and frequencies.

FITS: image ``data`` (time, product, frequency), ``freq`` in MHz, ``combinations`` (pairs of ports;
an auto has one column, a cross two, Re and Im). Header: LUNAR_DAY (start and end, UTC), DELTAT_SEC,
LUN_LAT_DEG, LUN_LONG_DEG; times are start + k DELTAT_SEC.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import astropy.units as u
import jax.numpy as jnp
import numpy as np
from astropy.io import fits
from astropy.time import Time
from jaxtyping import Float

from lusee_bayes.checks import InputError
from lusee_bayes.fits_images import read_images
from lusee_bayes.layout import DataLayout
from lusee_bayes.observation import Observation, unannounced_leap_seconds
from lusee_bayes.products import Product, all_products
from lusee_bayes.visibilities import Visibilities

IMAGES = ("data", "freq", "combinations")
KEYS = ("LUNAR_DAY", "DELTAT_SEC", "LUN_LAT_DEG", "LUN_LONG_DEG")
# two frequencies that differ by less, relatively, are one
SAME_FREQUENCY = 1e-9


@dataclass(frozen=True)
class Waterfall:
    """Visibilities of several frequencies, NaN where there are none.

    grid : (products, times, frequencies) in K, in the package's order of products
    """

    path: str
    grid: Float[np.ndarray, "products times frequencies"]
    frequencies_mhz: Float[np.ndarray, " frequencies"]
    observation: Observation

    def at(self, frequency_mhz: float) -> Visibilities:
        """One channel; samples that are not there or not finite are left out.

        InputError for a frequency that the file does not have.
        """
        known = self.frequencies_mhz
        channel = int(np.argmin(np.abs(known - frequency_mhz)))
        if not np.isclose(known[channel], frequency_mhz, rtol=SAME_FREQUENCY):
            raise InputError(
                f"{self.path} has no channel at {frequency_mhz:g} MHz (it has "
                f"{', '.join(f'{f:g}' for f in known)}); use --set frequency_mhz="
                f"{known[channel]:g}"
            )
        values = self.grid[:, :, channel]
        try:
            layout = DataLayout.from_flags(~np.isfinite(values))
        except InputError as error:
            raise InputError(f"{self.path} at {frequency_mhz:g} MHz: {error}") from error
        data = layout.gather(jnp.asarray(np.nan_to_num(values, posinf=0.0, neginf=0.0)))
        return Visibilities(data, layout, self.observation, float(known[channel]))


def read_waterfall(path: str | Path) -> Waterfall:
    """Read a waterfall of luseepy's scalar simulator; any subset and order of products.

    InputError for a missing or truncated file, a missing image or header entry (named), columns
    that do not fit the products, ports beyond 0..3, a bad date.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"no data at '{path}'")
    images, header = read_images(path, IMAGES, "a waterfall of luseepy's simulator")
    missing = [key for key in KEYS if key not in header]
    if missing:
        raise InputError(f"{path}: the header has no {missing[0]}; expected {', '.join(KEYS)}")
    data, frequencies = images["data"].astype(np.float64), images["freq"].astype(np.float64)
    columns = _columns(path, images["combinations"])
    if data.ndim != 3 or data.shape[1:] != (len(columns), len(frequencies)):
        raise InputError(
            f"{path}: data has shape {data.shape}, expected (times, {len(columns)}, "
            f"{len(frequencies)}) for the products in combinations and the channels in freq"
        )
    places = {product: k for k, product in enumerate(all_products())}
    grid = np.full((len(places), len(data), len(frequencies)), np.nan)
    for column, (product, sign) in enumerate(columns):
        grid[places[product]] = sign * data[:, column]
    return Waterfall(str(path), grid, frequencies, _observation(path, header, len(data)))


def _columns(path: Path, combinations: np.ndarray) -> list[tuple[Product, float]]:
    """The product in each column of the data, and its sign: V_ji is V_ij conjugated."""
    if combinations.ndim != 2 or combinations.shape[1] != 2:
        raise InputError(f"{path}: combinations has shape {combinations.shape}, expected (n, 2)")
    columns: list[tuple[Product, float]] = []
    for i, j in combinations.astype(int):
        if not (0 <= i <= 3 and 0 <= j <= 3):
            raise InputError(f"{path}: combinations names the ports {i} and {j}; there are 0 to 3")
        low, high = (int(min(i, j)), int(max(i, j)))
        columns.append((Product(low, high, "R"), 1.0))
        if i != j:
            columns.append((Product(low, high, "I"), 1.0 if i < j else -1.0))
    products = [product for product, _ in columns]
    if len(set(products)) < len(products):
        raise InputError(f"{path}: combinations names the same pair of ports twice")
    return columns


def _observation(path: Path, header: fits.Header, n_times: int) -> Observation:
    start = str(header["LUNAR_DAY"]).split(" to ")[0]
    try:
        with unannounced_leap_seconds():
            times = Time(start, scale="utc") + header["DELTAT_SEC"] * np.arange(n_times) * u.s
    except ValueError as error:
        raise InputError(
            f"{path}: LUNAR_DAY is '{header['LUNAR_DAY']}', expected '2025-02-01 00:00:00 to ...'"
        ) from error
    return Observation(
        float(header["LUN_LONG_DEG"]),
        float(header["LUN_LAT_DEG"]),
        times,
        np.zeros(n_times, dtype=int),
        (0.0,),
        float(header["DELTAT_SEC"]),
    )
