"""The map to point at: its data, packed into the page, and its place on it."""

from __future__ import annotations

import base64
import json
from pathlib import Path

import numpy as np
import xarray as xr
from jaxtyping import Float
from matplotlib import colormaps

from lusee_bayes.core.harmonics import lmax_of, mode_numbers, n_modes
from lusee_bayes.core.lazy import coordinates, healpy
from lusee_bayes.report import html
from lusee_bayes.report.figures.drawing import DIVERGING, SEQUENTIAL, seen_range
from lusee_bayes.sky import SkyMap
from lusee_bayes.sky.bright_sources import BRIGHT_SOURCES

# of the map that point-spread functions are drawn on
KERNEL_NSIDE = 16
# multipoles of point-spread functions, at most: a page with more would be too large
LARGEST_ELL = 47

# what every view of the sky has: zoom, grid, names, colour bar
CONTROLS = """<label for="explorer-grid">grid <select id="explorer-grid">
<option value="galactic">Galactic</option><option value="equatorial">equatorial</option>
<option value="none">none</option></select></label>
<label for="explorer-names">sources <input id="explorer-names" type="checkbox" checked></label>
<span><button type="button" id="explorer-in" aria-label="zoom in">+</button>
<button type="button" id="explorer-out" aria-label="zoom out">-</button></span>
<span class="bar"><canvas id="explorer-bar" width="400" height="42" role="img"
aria-label="colour scale"></canvas> <span id="explorer-unit"></span></span>"""
LAYOUT = f"""<div class="controls">
<label for="explorer-layer">show <select id="explorer-layer"></select></label>
<label for="explorer-l">l [°] <input id="explorer-l" type="number" step="0.1"></label>
<label for="explorer-b">b [°] <input id="explorer-b" type="number" step="0.1"></label>
{CONTROLS}
</div>
<canvas id="explorer-map" width="1200" height="600" tabindex="0" role="img"></canvas>
<p id="explorer-hover" class="hover">&nbsp;</p>
<p>Galactic Mollweide view, centre l = 0, longitude grows to the left; dashes: the rim of what was
never above the horizon, hatched where standard deviations are shown. Click, or move with the arrow
keys; double-click, the buttons or the wheel with Ctrl zoom, dragging moves.</p>
<div class="explorer">
<div><h3>Posterior there</h3><dl id="explorer-values" aria-live="polite"></dl></div>
<div><h3>Point-spread function there</h3>
<canvas id="explorer-psf" width="600" height="300" role="img"
aria-label="point-spread function of the chosen direction"></canvas>
<p>How the mean in this very direction weighs the sky, over its peak: orange adds, purple takes
away.</p></div>
</div>"""
SCRIPTS = ("sky_view.js", "point_spread.js", "explorer.js")


def explorer(folder: Path, diagnostics: xr.Dataset) -> str:
    """The explorer of a map run's folder as HTML with its data and its script."""
    return with_scripts(LAYOUT, explorer_data(folder, diagnostics), SCRIPTS)


def with_scripts(layout: str, found: dict[str, object], scripts: tuple[str, ...]) -> str:
    """A layout, its data, and what draws them."""
    data = json.dumps(found).replace("</", "<\\/")
    return "\n".join(
        [
            layout,
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
    temperature = {"unit": "K", "low": low, "high": high, "log": True, "colours": "sequential"}
    altitude = diagnostics["highest_altitude"].values
    layers = [
        ("mean", "posterior mean", mean, temperature),
        ("std", "standard deviation", std, std_scale(std, altitude)),
    ]
    if truth is not None:
        limit = np.percentile(np.abs(mean - truth), 99.0)
        layers += [
            ("truth", "truth", truth, temperature),
            ("residual", "mean - truth", None, signed_scale(limit, "K")),
            ("pull", "pull, (mean - truth) / standard deviation", None, signed_scale(4.0, "sigma")),
        ]
    fraction = diagnostics["prior_fraction"].values
    layers.append(("prior_fraction", "share from the prior", fraction, _range(fraction, "")))
    for k, draw in enumerate(diagnostics["draws"].values, 1):
        layers.append((f"draw{k}", f"draw {k} of the posterior", draw, temperature))
    layers.append(("highest_altitude", "highest altitude", altitude, _range(altitude, "")))
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
    ell, _ = mode_numbers(lmax)
    steps = diagnostics["resolution_step"].values[: ell[-1] + 1, : ell[-1] + 1]
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


def std_scale(
    std: Float[np.ndarray, " pixels"], altitude: Float[np.ndarray, " pixels"]
) -> dict[str, object]:
    """A logarithmic scale over what was seen."""
    low, high = seen_range(std, altitude)
    return {"unit": "K", "low": low, "high": high, "log": True, "colours": "sequential"}


def signed_scale(limit: float, unit: str) -> dict[str, object]:
    """A linear scale about zero."""
    return {"unit": unit, "low": -limit, "high": limit, "log": False, "colours": "diverging"}


def _range(values: Float[np.ndarray, " pixels"], unit: str) -> dict[str, object]:
    low, high = np.percentile(values, [0.5, 99.5])
    return {"unit": unit, "low": low, "high": high, "log": False, "colours": "sequential"}


def packed(values: np.ndarray) -> str:
    """Single precision, base64."""
    return base64.b64encode(np.asarray(values, dtype="<f4").tobytes()).decode()


def _colours(name: str) -> str:
    return base64.b64encode(colormaps[name](np.arange(256), bytes=True)[:, :3].tobytes()).decode()
