"""Waterfalls of luseepy's scalar simulator: visibilities in K.

FITS: image ``data`` (time, product, frequency), ``freq`` in MHz, ``combinations`` (pairs of ports;
an auto has one column, a cross two, Re and Im). Header: LUNAR_DAY (:mod:`.time_range`), DELTAT_SEC,
LUN_LAT_DEG, LUN_LONG_DEG; times are start + k DELTAT_SEC. Impedances of the ports in Ohm, ZRe_i and
ZIm_i, are there for luseepy's conversion to V^2/Hz.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import astropy.units as u
import numpy as np
from jaxtyping import Int

from lusee_bayes.core.errors import InputError
from lusee_bayes.core.formats import read_fits
from lusee_bayes.core.layouts import Attribute, Layout, Variable
from lusee_bayes.core.reading import naming
from lusee_bayes.instrument.observation import Observation
from lusee_bayes.instrument.products import N_ANTENNAS, Product, all_products
from lusee_bayes.instrument.times import require_ephemeris, unannounced_leap_seconds
from lusee_bayes.instrument.waterfalls.time_range import start_of
from lusee_bayes.instrument.waterfalls.waterfall import SITE_AND_STEP, Waterfall

LAYOUT = Layout(
    "a waterfall of luseepy's simulator",
    {
        "freq": Variable(("freq",), low=0.0, grows=True, unit="MHz"),
        # NaN where a sample is missing
        "data": Variable(("time", "product", "freq"), finite=False, unit="K"),
        "combinations": Variable(("pair", 2), "integer", low=0.0, high=N_ANTENNAS - 1.0),
    },
    {"LUNAR_DAY": Attribute("word"), **SITE_AND_STEP},
)


def read_scalar(path: Path) -> Waterfall:
    """Read a waterfall of luseepy's scalar simulator, with any products in any order.

    Parameters
    ----------
    path : Path

    Returns
    -------
    Waterfall

    Raises
    ------
    InputError
        For a truncated file, a missing image or header entry, columns that do not fit the
        products, ports beyond 0..3, or a bad date.
    """
    found = read_fits(path, LAYOUT)
    data, frequencies = found.arrays["data"], found.arrays["freq"]
    columns = _columns(path, found.arrays["combinations"])
    if data.shape[1] != len(columns):
        raise InputError(
            f"{path}: data has {data.shape[1]} products, expected {len(columns)} for the pairs of "
            "ports in combinations"
        )
    places = {product: k for k, product in enumerate(all_products())}
    grid = np.full((len(places), len(data), len(frequencies)), np.nan)
    for column, (product, sign) in enumerate(columns):
        grid[places[product]] = sign * data[:, column]
    return Waterfall(str(path), grid, frequencies, _observation(path, found.values, len(data)))


def _columns(path: Path, combinations: Int[np.ndarray, "pairs 2"]) -> list[tuple[Product, float]]:
    """The product in each column of the data, and its sign: V_ji is V_ij conjugated."""
    columns: list[tuple[Product, float]] = []
    for i, j in combinations:
        low, high = (int(min(i, j)), int(max(i, j)))
        columns.append((Product(low, high, "R"), 1.0))
        if i != j:
            columns.append((Product(low, high, "I"), 1.0 if i < j else -1.0))
    products = [product for product, _ in columns]
    if len(set(products)) < len(products):
        raise InputError(f"{path}: combinations names the same pair of ports twice")
    return columns


def _observation(path: Path, said: dict[str, Any], n_times: int) -> Observation:
    with naming(path):
        first = start_of(said["LUNAR_DAY"])
        require_ephemeris(first.jd + np.array([(n_times - 1) * said["DELTAT_SEC"] / 86400.0]))
        with unannounced_leap_seconds():
            times = first + said["DELTAT_SEC"] * np.arange(n_times) * u.s
        return Observation(
            said["LUN_LONG_DEG"],
            said["LUN_LAT_DEG"],
            times,
            np.zeros(n_times, dtype=int),
            (0.0,),
            said["DELTAT_SEC"],
        )
