"""Waterfalls of luseepy's scalar simulator: visibilities in K.

FITS: image ``data`` (time, product, frequency), ``freq`` in MHz, ``combinations`` (pairs of ports;
an auto has one column, a cross two, Re and Im). Header: LUNAR_DAY (:mod:`.time_range`), DELTAT_SEC,
LUN_LAT_DEG, LUN_LONG_DEG; times are start + k DELTAT_SEC. Impedances of the ports in Ohm, ZRe_i and
ZIm_i, are there for luseepy's conversion to V^2/Hz.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import astropy.units as u
import numpy as np
from astropy.io import fits
from astropy.time import Time
from jaxtyping import Complex, Int

from lusee_bayes.core.errors import InputError
from lusee_bayes.core.files import replacing
from lusee_bayes.core.fits_files import read_fits
from lusee_bayes.core.layouts import Attribute, Layout, Variable
from lusee_bayes.core.reading import naming
from lusee_bayes.core.version import __version__
from lusee_bayes.instrument.observation import (
    Observation,
    require_ephemeris,
    unannounced_leap_seconds,
)
from lusee_bayes.instrument.products import N_ANTENNAS, Product, all_products
from lusee_bayes.instrument.visibilities import Visibilities
from lusee_bayes.instrument.waterfalls.time_range import start_of
from lusee_bayes.instrument.waterfalls.waterfall import SITE_AND_STEP, Waterfall

LAYOUT = Layout(
    "a waterfall of luseepy's simulator",
    {
        "freq": Variable(("freq",), low=0.0, grows=True),
        # a sample that is not finite is missing
        "data": Variable(("time", "product", "freq"), missing=True),
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


def write_waterfall(
    path: str | Path,
    channels: Sequence[Visibilities],
    impedance_ohm: Complex[np.ndarray, " frequencies"] | None = None,
    scenario: str | None = None,
) -> Path:
    """Write channels of one observation as luseepy's scalar simulator does, whole or not at all.

    Missing samples become NaN.

    Parameters
    ----------
    path : str or Path
    channels : sequence of Visibilities
    impedance_ohm : (frequencies,) complex array, optional
        Of the arms; NaN where it is not known.
    scenario : str, optional
        Text of the scenario, stored as an image of bytes that luseepy ignores.

    Returns
    -------
    Path

    Raises
    ------
    InputError
        For what the layout cannot hold: times other than start + k step, turntable angles other
        than 0, other than four ports, channels of different observations, fewer than two channels.
    """
    path, first = Path(path), channels[0].observation
    if len(channels) < 2:
        raise InputError(
            f"{path}: luseepy's reader takes waterfalls of at least two channels; give it "
            "--frequencies, or write netCDF (a name that does not end in .fits)"
        )
    for channel in channels:
        _require_writable(path, channel, first)
    grid = np.stack([channel.grid() for channel in channels], axis=-1)
    pairs = [(p.i, p.j) for p in all_products() if p.part == "R"]
    z = np.full(len(channels), np.nan + 1j * np.nan) if impedance_ohm is None else impedance_ohm
    images = {
        "data": np.moveaxis(grid, 0, 1),
        "freq": np.array([channel.frequency_mhz for channel in channels]),
        "combinations": np.array(pairs),
    }
    for port in range(N_ANTENNAS):
        images |= {f"ZRe_{port}": z.real.copy(), f"ZIm_{port}": z.imag.copy()}
    if scenario is not None:
        images["scenario"] = np.frombuffer(scenario.encode(), dtype=np.uint8)
    hdus = fits.HDUList([fits.PrimaryHDU(images["data"])])
    for name, image in images.items():
        if name != "data":
            hdus.append(fits.ImageHDU(image, name=name))
    with unannounced_leap_seconds():
        # luseepy counts steps up to the end: half a step less leaves no room for rounding
        end = first.times[-1] - 0.5 * first.step_s * u.s
    header = {
        "EXTNAME": "data",
        "VERSION": 0.1,
        "LUNAR_DAY": f"{_written(first.times[0])} to {_written(end)}",
        "LUN_LAT_DEG": first.lat_deg,
        "LUN_LONG_DEG": first.lon_deg,
        "LUN_HEIGHT_M": 0.0,
        "DELTAT_SEC": first.step_s,
        "CREATOR": f"lusee_bayes {__version__}",
    }
    for key, value in header.items():
        hdus[0].header[key if len(key) <= 8 else f"HIERARCH {key}"] = value
    with replacing(path) as partial:
        hdus.writeto(partial)
    return path


def _written(time: Time) -> str:
    """A time as luseepy reads it, to the nanosecond."""
    exact = time.copy(format="iso")
    exact.precision = 9
    return str(exact.value)


def _require_writable(path: Path, channel: Visibilities, first: Observation) -> None:
    """InputError unless luseepy's layout can hold a channel of this observation."""
    observation = channel.observation
    hint = "write netCDF instead (a name that does not end in .fits)"
    if observation.turntable_deg != (0.0,):
        raise InputError(
            f"{path}: luseepy's waterfalls have no turntable angles, the data have "
            f"{observation.turntable_deg}; {hint}"
        )
    if channel.layout.n_products != N_ANTENNAS**2:
        raise InputError(f"{path}: expected {N_ANTENNAS**2} products; {hint}")
    with unannounced_leap_seconds():
        seconds = (observation.times - first.times[0]).to_value(u.s)
    steps = first.step_s * np.arange(first.n_times)
    # the time of a Julian date in two parts is exact to less than a nanosecond
    if seconds.shape != steps.shape or np.abs(seconds - steps).max() > 1e-6:
        raise InputError(
            f"{path}: luseepy's waterfalls have a sample every {first.step_s:g} s without gaps; "
            f"{hint}"
        )
