"""Write waterfalls in luseepy's layouts: what its scalar and its four-port files share."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import astropy.units as u
import numpy as np
from astropy.io import fits
from astropy.time import Time
from jaxtyping import Complex, Float

from lusee_bayes.core.errors import InputError
from lusee_bayes.core.files import replacing, user_path
from lusee_bayes.core.version import __version__
from lusee_bayes.instrument.observation import Observation
from lusee_bayes.instrument.products import N_ANTENNAS, all_products
from lusee_bayes.instrument.times import unannounced_leap_seconds
from lusee_bayes.instrument.visibilities import Visibilities

HINT = "write netCDF instead (a name that does not end in .fits)"
NO_ROOM = (
    "luseepy's waterfalls have no room for windows, and the samples are means over theirs; write "
    "netCDF (a name that does not end in .fits), or simulate with --set observation.window=instant"
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
        For what the layout cannot hold: windows, times other than start + k step, turntable angles
        other than 0, other than four ports, channels of different observations, fewer than two
        channels.
    """
    path, first = user_path(path), channels[0].observation
    if len(channels) < 2:
        raise InputError(
            f"{path}: luseepy's reader takes waterfalls of at least two channels; give it "
            "--frequencies, or write netCDF (a name that does not end in .fits)"
        )
    grid = grid_of(path, channels)
    with unannounced_leap_seconds():
        seconds = (first.times - first.times[0]).to_value(u.s)
    # the time of a Julian date in two parts is exact to less than a nanosecond
    if np.abs(seconds - first.step_s * np.arange(first.n_times)).max() > 1e-6:
        raise InputError(
            f"{path}: luseepy's waterfalls have a sample every {first.step_s:g} s without gaps; "
            f"{HINT}"
        )
    pairs = [(p.i, p.j) for p in all_products() if p.part == "R"]
    z = np.full(len(channels), np.nan + 1j * np.nan) if impedance_ohm is None else impedance_ohm
    images = {
        "data": grid,
        "freq": np.array([channel.frequency_mhz for channel in channels]),
        "combinations": np.array(pairs),
    }
    for port in range(N_ANTENNAS):
        images |= {f"ZRe_{port}": z.real.copy(), f"ZIm_{port}": z.imag.copy()}
    hdus = [fits.ImageHDU(image, name=name) for name, image in images.items()]
    return write_hdus(path, hdus, {"VERSION": 0.1} | site_and_times(first), scenario)


def grid_of(
    path: Path, channels: Sequence[Visibilities]
) -> Float[np.ndarray, "times products frequencies"]:
    """Return the samples of all channels in K, NaN where they are missing.

    Raises
    ------
    InputError
        For samples with windows, turntable angles other than 0, other than four ports, or channels
        of different times.
    """
    first = channels[0].observation
    for channel in channels:
        observation = channel.observation
        if observation.windows is not None:
            raise InputError(f"{path}: {NO_ROOM}")
        if observation.turntable_deg != (0.0,):
            raise InputError(
                f"{path}: luseepy's waterfalls have no turntable angles, the data have "
                f"{observation.turntable_deg}; {HINT}"
            )
        if channel.layout.n_products != N_ANTENNAS**2:
            raise InputError(f"{path}: expected {N_ANTENNAS**2} products; {HINT}")
        same = observation.n_times == first.n_times
        if not same or not bool((observation.times == first.times).all()):
            raise InputError(f"{path}: the channels have different times; {HINT}")
    return np.moveaxis(np.stack([channel.grid() for channel in channels], axis=-1), 0, 1)


def site_and_times(observation: Observation) -> dict[str, Any]:
    """Return the words of the header that say where and when."""
    with unannounced_leap_seconds():
        # luseepy counts steps up to the end: half a step less leaves no room for rounding
        end = observation.times[-1] - 0.5 * observation.step_s * u.s
    return {
        "LUNAR_DAY": f"{_written(observation.times[0])} to {_written(end)}",
        "LUN_LAT_DEG": observation.lat_deg,
        "LUN_LONG_DEG": observation.lon_deg,
        "LUN_HEIGHT_M": 0.0,
        "DELTAT_SEC": observation.step_s,
    }


def write_hdus(
    path: Path,
    hdus: Sequence[fits.ImageHDU | fits.BinTableHDU],
    header: Mapping[str, Any],
    scenario: str | None,
) -> Path:
    """Write a FITS file, whole or not at all.

    Parameters
    ----------
    path : Path
    hdus : sequence of ImageHDU or BinTableHDU
        The first one, ``data``, becomes the primary image.
    header : mapping
        Words of its header.
    scenario : str or None
        Text of the scenario, for an image of bytes.
    """
    primary = fits.PrimaryHDU(hdus[0].data)
    for key, value in ({"EXTNAME": "data"} | dict(header)).items():
        primary.header[key if len(key) <= 8 else f"HIERARCH {key}"] = value
    primary.header["CREATOR"] = f"lusee_bayes {__version__}"
    written = fits.HDUList([primary, *hdus[1:]])
    if scenario is not None:
        image = np.frombuffer(scenario.encode(), dtype=np.uint8)
        written.append(fits.ImageHDU(image, name="scenario"))
    with replacing(path) as partial:
        written.writeto(partial)
    return path


def _written(time: Time) -> str:
    """A time as luseepy reads it, to the nanosecond."""
    exact = time.copy(format="iso")
    exact.precision = 9
    return str(exact.value)
