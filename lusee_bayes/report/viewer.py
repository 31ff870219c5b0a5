"""Interactive maps: the data that ``viewer.js`` draws, packed into the page.

The page has the coefficients of the skies and draws them at any NSIDE, for any number of channels.
Standard deviations are stored as coarser pixels of two bytes, which it interpolates.
"""

import base64
from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib import colormaps, colors

from lusee_bayes.core.harmonics import lmax_of, n_modes
from lusee_bayes.core.lazy import coordinates, healpy
from lusee_bayes.report.figures.drawing import DIVERGING, SEQUENTIAL, rim
from lusee_bayes.report.figures.maps import NSIDE, scales
from lusee_bayes.results.channel import ChannelResult, Details
from lusee_bayes.sky.galaxy import BRIGHT_SOURCES

# NSIDE at which point-spread functions are drawn
KERNEL_NSIDE = 64
# largest multipole of point-spread functions: a page with more would be too large
LARGEST_ELL = 47
# largest size of all pixels in bytes, before base64; two bytes per number
BUDGET, LEVELS = 3_500_000, 65535

Maps = Float[np.ndarray, "channels pixels"]


def viewer(name: str, channels: Sequence[ChannelResult]) -> dict[str, Any]:
    """Data that ``viewer.html`` shows for one or several channels.

    Parameters
    ----------
    name : str
        Name of the run, for downloads.
    channels : sequence of ChannelResult
        A channel with details also shows draws, regions, the prior's share and point-spread
        functions. If the truth of all is known, differences from it are shown, too.
    """
    skies = {"mean": [channel.mean for channel in channels]}
    pixels = {"std": np.stack([channel.pixel_std for channel in channels])}
    if all(channel.truth is not None for channel in channels):
        skies["truth"] = [channel.truth for channel in channels]
    regions, resolutions, details = None, [], channels[0].details
    if details is not None:
        pixels["prior_fraction"] = details.prior_fraction[None]
        skies |= {f"draw{k}": [sky] for k, sky in enumerate(details.draws, 1)}
        regions, resolutions = _regions(details), [resolution(details)]
    altitude = channels[0].highest_altitude
    axes = coordinates.SkyCoord([0.0, 90.0, 0.0], [0.0, 0.0, 90.0], unit="deg", frame="galactic")
    sources = [(source.name, *source.galactic()) for source in BRIGHT_SOURCES]
    colours = [scales(channel) for channel in channels]
    nside = nside_of_page(channels[0].nside, len(pixels) * len(channels))
    return {
        "name": name,
        "frequencies": [channel.frequency_mhz for channel in channels],
        "nside": max(NSIDE, channels[0].nside),
        "skies": {key: packed(np.stack(modes)) for key, modes in skies.items()},
        "pixels": {key: _quantised(cube, nside) for key, cube in pixels.items()},
        "mean_k": [float(channel.mean[0] / np.sqrt(4.0 * np.pi)) for channel in channels],
        "scales": {key: [_bounds(one[key]) for one in colours] for key in colours[0]},
        "highest_altitude": packed(altitude),
        "rim": [np.round(line, 1).tolist() for line in rim(altitude)],
        "regions": regions,
        "resolutions": resolutions,
        "colours": {
            kind: _base64(colormaps[name](np.arange(256), bytes=True)[:, :3])
            for kind, name in {"sequential": SEQUENTIAL, "diverging": DIVERGING}.items()
        },
        # from Galactic to ICRS; columns: where the Galactic axes point
        "rotation": axes.icrs.cartesian.xyz.value.ravel().tolist(),
        "sources": [{"name": name, "l": lon, "b": lat} for name, lon, lat in sources],
    }


def resolution(details: Details) -> dict[str, Any]:
    """The resolution matrix of a channel in units of the prior, for point_spread.js."""
    lmax = min(LARGEST_ELL, lmax_of(len(details.prior_width)))
    n = n_modes(lmax)
    entries = details.resolution[:n, :n].astype(np.int8)
    symmetric = bool((entries == entries.T).all())
    return {
        "lmax": lmax,
        "nside": KERNEL_NSIDE,
        "symmetric": symmetric,
        "entries": _base64(entries[np.triu_indices(n)] if symmetric else entries),
        "steps": packed(details.resolution_step[: lmax + 1, : lmax + 1]),
        "prior_std": packed(details.prior_width[:n]),
    }


def nside_of_page(nside: int, n_maps: int) -> int:
    """The finest NSIDE, at most that of the maps, that keeps them within the budget."""
    while nside > 1 and 2 * 12 * nside**2 * n_maps > BUDGET:
        nside //= 2
    return nside


def packed(values: np.ndarray) -> str:
    """Encode numbers in single precision and base64."""
    return _base64(np.asarray(values, dtype="<f4"))


def _quantised(cube: Maps, nside: int) -> dict[str, Any]:
    """Degrade every channel; quantise it from its smallest to its largest value in 65535 steps."""
    if healpy.npix2nside(cube.shape[1]) != nside:
        cube = np.stack([healpy.ud_grade(pixels, nside) for pixels in cube])
    low, high = cube.min(axis=1), cube.max(axis=1)
    step = np.where(high > low, high - low, 1.0) / LEVELS
    levels = np.rint((cube - low[:, None]) / step[:, None]).astype("<u2")
    scale = {"low": low.tolist(), "step": step.tolist()}
    return {"nside": nside, **scale, "levels": _base64(levels)}


def _bounds(norm: colors.Normalize) -> dict[str, Any]:
    low, high = float(norm.vmin), float(norm.vmax)
    return {"low": low, "high": high, "log": isinstance(norm, colors.LogNorm)}


def _regions(details: Details) -> dict[str, Any]:
    names = ("mean", "std", "prior_fraction")
    regions = {name: getattr(details, f"region_{name}") for name in names}
    nside = healpy.npix2nside(regions["mean"].size)
    return {
        "nside": nside,
        "size_deg": float(np.degrees(healpy.nside2resol(nside))),
        **{name: packed(values) for name, values in regions.items()},
    }


def _base64(values: np.ndarray) -> str:
    return base64.b64encode(values.tobytes()).decode()
