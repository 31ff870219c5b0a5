"""Maps to look into: what ``viewer.js`` draws, packed into the page.

Any number of channels stands behind one view. Many of them are kept in two bytes a pixel, coarser
where there are too many for a page; one keeps its resolution, in single precision.
"""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib import colormaps

from lusee_bayes.core.arrays import Pixels
from lusee_bayes.core.errors import InputError
from lusee_bayes.core.harmonics import lmax_of, n_modes
from lusee_bayes.core.lazy import coordinates, healpy
from lusee_bayes.report.figures.drawing import DIVERGING, SEQUENTIAL, seen_range
from lusee_bayes.results.channel import Details
from lusee_bayes.sky.galaxy import BRIGHT_SOURCES

# of the map that point-spread functions are drawn on
KERNEL_NSIDE = 16
# multipoles of point-spread functions, at most: a page with more would be too large
LARGEST_ELL = 47
# what the maps of many channels may take, in bytes, before base64; two bytes a number
BUDGET = 3_500_000
LEVELS = 65535

Maps = Float[np.ndarray, "channels pixels"]


def viewer(
    frequencies_mhz: Sequence[float],
    maps: Mapping[str, Maps],
    *,
    highest_altitude: Pixels,
    regions: Mapping[str, Float[np.ndarray, "channels regions"]] | None = None,
    resolutions: Sequence[Mapping[str, Any]] = (),
) -> dict[str, Any]:
    """What ``viewer.html`` shows: maps, and whatever else is given, of one channel or many.

    Parameters
    ----------
    frequencies_mhz : sequence of float
        Of the channels.
    maps : mapping of (channels, pixels) arrays
        HEALPix RING, Galactic, by name: "mean" and "std" in K; where they are known "truth" in K,
        "prior_fraction" and draws in K, "draw1" and so on. Differences from the truth follow.
    highest_altitude : (pixels,) array
        sin of the highest altitude of each pixel: what never rose is marked.
    regions : mapping of (channels, regions) arrays, optional
        "mean" and "std" in K and "prior_fraction" of larger pixels.
    resolutions : sequence of mappings, optional
        :func:`resolution` of every channel, for point-spread functions.

    Raises
    ------
    InputError
        If maps are of other channels or pixels than the mean.
    """
    channels = len(frequencies_mhz)
    full, nside = _nsides(maps, channels)
    pack = _quantised if channels > 1 else lambda cube: {"values": packed(cube)}
    maps = {name: _degraded(cube, nside) for name, cube in maps.items()}
    altitude = _degraded(highest_altitude[None], nside)[0]
    return {
        "frequencies": list(frequencies_mhz),
        "nside": nside,
        "full_nside": full,
        "maps": {name: pack(cube) for name, cube in maps.items()},
        "scales": _scales(maps, altitude),
        "highest_altitude": packed(altitude),
        "regions": None if regions is None else _regions(regions),
        "resolutions": list(resolutions),
        **_furniture(),
    }


def resolution(details: Details) -> dict[str, Any]:
    """The resolution matrix of a channel in units of the prior, for point_spread.js."""
    lmax = min(LARGEST_ELL, lmax_of(len(details.prior_width)))
    n = n_modes(lmax)
    known = details.resolution[:n, :n].astype(np.int8)
    symmetric = bool((known == known.T).all())
    return {
        "lmax": lmax,
        "nside": KERNEL_NSIDE,
        "symmetric": symmetric,
        "entries": _base64(known[np.triu_indices(n)] if symmetric else known),
        "steps": packed(details.resolution_step[: lmax + 1, : lmax + 1]),
        "prior_std": packed(details.prior_width[:n]),
    }


def nside_of_page(nside: int, n_maps: int) -> int:
    """The finest NSIDE, down from that of the maps, with which they stay within the budget."""
    while nside > 1 and 2 * 12 * nside**2 * n_maps > BUDGET:
        nside //= 2
    return nside


def packed(values: np.ndarray) -> str:
    """Single precision, base64."""
    return _base64(np.asarray(values, dtype="<f4"))


def _nsides(maps: Mapping[str, Maps], channels: int) -> tuple[int, int]:
    """NSIDE of the maps, and of those of the page. InputError if the maps do not go together."""
    pixels = maps["mean"].shape[1]
    for name, cube in maps.items():
        if cube.shape != (channels, pixels) or not healpy.isnpixok(pixels):
            raise InputError(
                f"maps of {name} have the shape {cube.shape}; expected {channels} channels of "
                f"{pixels} pixels, like the mean, on a HEALPix grid; rerun the map"
            )
    nside = healpy.npix2nside(pixels)
    return nside, nside_of_page(nside, len(maps) * channels) if channels > 1 else nside


def _degraded(cube: Maps, nside: int) -> Maps:
    if healpy.npix2nside(cube.shape[1]) == nside:
        return cube
    return np.stack([healpy.ud_grade(pixels, nside) for pixels in cube])


def _quantised(cube: Maps) -> dict[str, Any]:
    """Every channel between its least and its largest value in 65535 steps, and its scale."""
    low, high = cube.min(axis=1), cube.max(axis=1)
    step = np.where(high > low, high - low, 1.0) / LEVELS
    levels = np.rint((cube - low[:, None]) / step[:, None]).astype("<u2")
    return {"low": low.tolist(), "step": step.tolist(), "levels": _base64(levels)}


def _scales(maps: Mapping[str, Maps], altitude: Pixels) -> dict[str, list[dict[str, Any]]]:
    """Bounds of the colours of every channel, by what they are of."""
    scales = {
        "temperature": [_temperature(sky) for sky in maps.get("truth", maps["mean"])],
        "std": [_scale(*seen_range(std, altitude), log=True) for std in maps["std"]],
    }
    if "truth" in maps:
        limits = np.percentile(np.abs(maps["mean"] - maps["truth"]), 99.0, axis=1)
        scales["residual"] = [_scale(-limit, limit) for limit in limits]
    if "prior_fraction" in maps:
        shares = np.percentile(maps["prior_fraction"], [0.5, 99.5], axis=1).T
        scales["prior_fraction"] = [_scale(*bounds) for bounds in shares]
    return scales


def _temperature(sky: Pixels) -> dict[str, Any]:
    """Logarithmic, of what is above zero; linear where nothing is."""
    positive = sky[sky > 0]
    log = bool(positive.size)
    return _scale(*np.percentile(positive if log else sky, [0.5, 99.8]), log=log)


def _scale(low: float, high: float, *, log: bool = False) -> dict[str, Any]:
    return {"low": float(low), "high": float(high), "log": log}


def _regions(regions: Mapping[str, Float[np.ndarray, "channels regions"]]) -> dict[str, Any]:
    nside = healpy.npix2nside(regions["mean"].shape[1])
    return {
        "nside": nside,
        "size_deg": float(np.degrees(healpy.nside2resol(nside))),
        **{name: packed(values) for name, values in regions.items()},
    }


def _furniture() -> dict[str, Any]:
    """Colours, the rotation from Galactic to ICRS, and the bright sources, for sky_view.js."""
    axes = coordinates.SkyCoord([0.0, 90.0, 0.0], [0.0, 0.0, 90.0], unit="deg", frame="galactic")
    names = [(source.name, *source.galactic()) for source in BRIGHT_SOURCES]
    return {
        "colours": {
            kind: _base64(colormaps[name](np.arange(256), bytes=True)[:, :3])
            for kind, name in {"sequential": SEQUENTIAL, "diverging": DIVERGING}.items()
        },
        # columns: where the Galactic axes point
        "rotation": axes.icrs.cartesian.xyz.value.ravel().tolist(),
        "sources": [{"name": name, "l": lon, "b": lat} for name, lon, lat in names],
    }


def _base64(values: np.ndarray) -> str:
    return base64.b64encode(values.tobytes()).decode()
