"""Maps to look into, with their data packed into the page.

That of one channel has the point-spread function of the direction that is pointed at; those of a
cube stand behind a slider, with the spectrum of the direction.
"""

from __future__ import annotations

import base64
import json
from pathlib import Path

import numpy as np
import xarray as xr
from jaxtyping import Float
from matplotlib import colormaps

from lusee_bayes.core.formats import opened
from lusee_bayes.core.harmonics import lmax_of, n_modes
from lusee_bayes.core.layouts import Layout, Variable
from lusee_bayes.core.lazy import coordinates, healpy
from lusee_bayes.report import html
from lusee_bayes.report.figures.drawing import DIVERGING, SEQUENTIAL, seen_range
from lusee_bayes.sky.galaxy import BRIGHT_SOURCES
from lusee_bayes.sky.sky_files import SkyMap

# of the map that point-spread functions are drawn on
KERNEL_NSIDE = 16
# multipoles of point-spread functions, at most: a page with more would be too large
LARGEST_ELL = 47

SCRIPTS = ("sky_view.js", "point_spread.js", "explorer.js")


def explorer(folder: Path, diagnostics: xr.Dataset) -> str:
    """The explorer of a map run's folder as HTML with its data and its script."""
    return _with_scripts("explorer.html", explorer_data(folder, diagnostics), SCRIPTS)


def _with_scripts(layout: str, found: dict[str, object], scripts: tuple[str, ...]) -> str:
    """A layout, its data, and what draws them."""
    data = json.dumps(found).replace("</", "<\\/")
    # zoom, grid, names and colour bar of every view
    controls = html.package_text("explorer_controls.html").rstrip("\n")
    return "\n".join(
        [
            html.package_text(layout).rstrip("\n").replace("{controls}", controls),
            f'<script type="application/json" id="explorer-data">{data}</script>',
            *(f"<script>\n{html.package_text(name)}\n</script>" for name in scripts),
        ]
    )


def explorer_data(folder: Path, diagnostics: xr.Dataset) -> dict[str, object]:
    """Maps in single precision, the resolution matrix in bytes; what explorer.js reads."""

    def read(name: str) -> Float[np.ndarray, " pixels"] | None:
        path = folder / f"{name}.fits"
        return SkyMap.read(path).pixels if path.is_file() else None

    mean, std, truth = read("mean"), read("std"), read("truth")
    sky = mean if truth is None else truth
    low, high = np.percentile(sky[sky > 0], [0.5, 99.8])
    temperature = _scale("K", low, high, log=True)
    altitude = diagnostics["highest_altitude"].values
    layers = [
        ("mean", "posterior mean", mean, temperature),
        ("std", "standard deviation", std, _scale("K", *seen_range(std, altitude), log=True)),
    ]
    if truth is not None:
        limit = np.percentile(np.abs(mean - truth), 99.0)
        layers += [
            ("truth", "truth", truth, temperature),
            ("residual", "mean - truth", None, _scale("K", -limit, limit, "diverging")),
            (
                "pull",
                "pull, (mean - truth) / standard deviation",
                None,
                _scale("sigma", -4.0, 4.0, "diverging"),
            ),
        ]
    fraction = diagnostics["prior_fraction"].values
    layers.append(("prior_fraction", "share from the prior", fraction, _range(fraction)))
    for k, draw in enumerate(diagnostics["draws"].values, 1):
        layers.append((f"draw{k}", f"draw {k} of the posterior", draw, temperature))
    layers.append(("highest_altitude", "highest altitude", altitude, _range(altitude)))
    coarse = healpy.npix2nside(diagnostics.sizes["region"])
    return {
        "nside": healpy.npix2nside(mean.size),
        "region_nside": coarse,
        "region_size_deg": float(np.degrees(healpy.nside2resol(coarse))),
        "layers": [
            {"key": key, "title": title, "values": None if v is None else packed(v), **scale}
            for key, title, v, scale in layers
        ],
        "regions": {
            name: packed(diagnostics[f"region_{name}"].values)
            for name in ("mean", "std", "prior_fraction")
        },
        "point_spread": _point_spread(diagnostics),
        **sky_furniture(),
    }


def _point_spread(diagnostics: xr.Dataset) -> dict[str, object]:
    """The resolution matrix in units of the prior, as point_spread.js reads it."""
    lmax = min(LARGEST_ELL, lmax_of(diagnostics.sizes["mode"]))
    n = n_modes(lmax)
    steps = diagnostics["resolution_step"].values[: lmax + 1, : lmax + 1]
    known = diagnostics["resolution"].values[:n, :n].astype(np.int8)
    symmetric = bool((known == known.T).all())
    entries = known[np.triu_indices(n)] if symmetric else known
    return {
        "lmax": lmax,
        "nside": KERNEL_NSIDE,
        "symmetric": symmetric,
        "entries": base64.b64encode(entries.tobytes()).decode(),
        "steps": packed(steps),
        "prior_std": packed(diagnostics["prior_std"].values[:n]),
    }


def sky_furniture() -> dict[str, object]:
    """Colours, the rotation from Galactic to ICRS, and the bright sources, for sky_view.js."""
    axes = coordinates.SkyCoord([0.0, 90.0, 0.0], [0.0, 0.0, 90.0], unit="deg", frame="galactic")
    names = [(source.name, *source.galactic()) for source in BRIGHT_SOURCES]
    return {
        "colours": {"sequential": _colours(SEQUENTIAL), "diverging": _colours(DIVERGING)},
        # columns: where the Galactic axes point
        "rotation": axes.icrs.cartesian.xyz.value.ravel().tolist(),
        "sources": [{"name": name, "l": lon, "b": lat} for name, lon, lat in names],
    }


def _range(values: Float[np.ndarray, " pixels"]) -> dict[str, object]:
    return _scale("", *np.percentile(values, [0.5, 99.5]))


def _scale(
    unit: str, low: float, high: float, colours: str = "sequential", *, log: bool = False
) -> dict[str, object]:
    return {"unit": unit, "low": low, "high": high, "log": log, "colours": colours}


def packed(values: np.ndarray) -> str:
    """Single precision, base64."""
    return base64.b64encode(np.asarray(values, dtype="<f4").tobytes()).decode()


def _colours(name: str) -> str:
    return base64.b64encode(colormaps[name](np.arange(256), bytes=True)[:, :3].tobytes()).decode()


CUBE = Layout("maps of every channel", {"maps": Variable(("channel", "pixel"))})
# what the maps of a page may take, in bytes, before base64; two bytes a number
BUDGET = 3_500_000
LEVELS = 65535
CUBE_SCRIPTS = ("sky_view.js", "cube_explorer.js")


def cube_explorer(folder: Path, frequencies_mhz: list[float]) -> str:
    """The explorer of the folder of a run of several frequencies."""
    return _with_scripts("cube_explorer.html", cube_data(folder, frequencies_mhz), CUBE_SCRIPTS)


def cube_data(folder: Path, frequencies_mhz: list[float]) -> dict[str, object]:
    """Maps in two bytes a pixel, coarser where there are many; what cube_explorer.js reads."""
    found = {
        name: _read(folder / f"{name}.fits")
        for name in ("mean", "std", "truth")
        if (folder / f"{name}.fits").is_file()
    }
    nside = healpy.npix2nside(found["mean"].shape[1])
    shown = nside_of_page(nside, len(found) * len(frequencies_mhz))
    maps = {
        name: np.stack([healpy.ud_grade(m, shown) for m in cube]) for name, cube in found.items()
    }
    return {
        "frequencies": frequencies_mhz,
        "nside": shown,
        "full_nside": nside,
        "cubes": {name: _quantised(cube) for name, cube in maps.items()},
        **sky_furniture(),
    }


def nside_of_page(nside: int, n_maps: int) -> int:
    """The finest NSIDE, down from that of the maps, with which they stay within the budget."""
    while nside > 1 and 2 * 12 * nside**2 * n_maps > BUDGET:
        nside //= 2
    return nside


def _read(path: Path) -> Float[np.ndarray, "channels pixels"]:
    with opened(path, CUBE.what) as hdus:
        there = {} if hdus[0].data is None else {"maps": hdus[0].data}
        return CUBE.checked(path, there, {}).arrays["maps"]


def _quantised(cube: Float[np.ndarray, "channels pixels"]) -> dict[str, object]:
    """Every channel between its least and its largest value in 65535 steps, and its scale."""
    low, high = cube.min(axis=1), cube.max(axis=1)
    step = np.where(high > low, high - low, 1.0) / LEVELS
    levels = np.rint((cube - low[:, None]) / step[:, None]).astype("<u2")
    return {
        "low": low.tolist(),
        "step": step.tolist(),
        "levels": base64.b64encode(levels.tobytes()).decode(),
    }
