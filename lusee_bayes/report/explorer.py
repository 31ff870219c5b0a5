"""The map to point at: its data, packed into the page, and its place on it."""

from __future__ import annotations

import base64
import json
from pathlib import Path

import numpy as np
import xarray as xr
from jaxtyping import Float
from matplotlib import colormaps

from lusee_bayes.core.lazy import healpy
from lusee_bayes.report import html
from lusee_bayes.report.figures.drawing import DIVERGING, SEQUENTIAL
from lusee_bayes.results.diagnostics import KERNEL_NSIDE
from lusee_bayes.results.diagnostics_file import KERNEL_STEP
from lusee_bayes.sky import SkyMap

LAYOUT = """<div class="controls">
<label for="explorer-layer">show <select id="explorer-layer"></select></label>
<label for="explorer-l">l [°] <input id="explorer-l" type="number" step="0.1"></label>
<label for="explorer-b">b [°] <input id="explorer-b" type="number" step="0.1"></label>
<span class="bar"><span id="explorer-low"></span>
<canvas id="explorer-bar" width="256" height="16" role="img" aria-label="colour scale"></canvas>
<span id="explorer-high"></span></span>
</div>
<canvas id="explorer-map" width="1200" height="600" tabindex="0" role="img"></canvas>
<p>Galactic Mollweide view, centre l = 0, longitude grows to the left; dashes: the rim of what was
never above the horizon. Click, or move with the arrow keys.</p>
<div class="explorer">
<div><h3>Posterior there</h3><dl id="explorer-values" aria-live="polite"></dl></div>
<div><h3>Point-spread function there</h3>
<canvas id="explorer-psf" width="600" height="300" role="img"
aria-label="point-spread function of the chosen direction"></canvas>
<p>How the pixel's mean weighs the sky, over its peak: orange: positive, purple: negative.</p></div>
</div>"""


def explorer(folder: Path, diagnostics: xr.Dataset) -> str:
    """The explorer of a map run's folder as HTML with its data and its script."""
    data = json.dumps(explorer_data(folder, diagnostics)).replace("</", "<\\/")
    return "\n".join(
        [
            LAYOUT,
            f'<script type="application/json" id="explorer-data">{data}</script>',
            f"<script>\n{html.package_text('explorer.js')}\n</script>",
        ]
    )


def explorer_data(folder: Path, diagnostics: xr.Dataset) -> dict[str, object]:
    """Maps in single precision, point-spread functions in bytes; what explorer.js reads."""

    def read(name: str) -> Float[np.ndarray, " pixels"] | None:
        path = folder / f"{name}.fits"
        return SkyMap.read(path).pixels if path.is_file() else None

    mean, std, truth = read("mean"), read("std"), read("truth")
    sky = mean if truth is None else truth
    low, high = np.percentile(sky[sky > 0], [0.5, 99.8])
    temperature = {"unit": "K", "low": low, "high": high, "log": True, "colours": "sequential"}
    layers = [
        ("mean", "posterior mean", mean, temperature),
        ("std", "standard deviation", std, _range(std, "K")),
    ]
    if truth is not None:
        layers.append(("truth", "truth", truth, temperature))
        limit = np.percentile(np.abs(mean - truth), 99.0)
        signed = {"unit": "K", "low": -limit, "high": limit, "log": False, "colours": "diverging"}
        layers.append(("residual", "mean - truth", mean - truth, signed))
    fraction = diagnostics["prior_fraction"].values
    layers.append(("prior_fraction", "share from the prior", fraction, _range(fraction, "")))
    for k, draw in enumerate(diagnostics["draws"].values, 1):
        layers.append((f"draw{k}", f"draw {k} of the posterior", draw, temperature))
    altitude = diagnostics["highest_altitude"].values
    layers.append(("highest_altitude", "highest altitude", altitude, _range(altitude, "")))
    coarse = healpy.npix2nside(diagnostics.sizes["region"])
    kernels = np.rint(diagnostics["psf"].values / KERNEL_STEP).astype(np.int8)
    return {
        "nside": healpy.npix2nside(mean.size),
        "region_nside": coarse,
        "kernel_nside": KERNEL_NSIDE,
        "region_size_deg": float(np.degrees(healpy.nside2resol(coarse))),
        "layers": [
            {"key": key, "title": title, "values": _packed(values), **scale}
            for key, title, values, scale in layers
        ],
        "regions": {
            name: _packed(diagnostics[f"region_{name}"].values)
            for name in ("mean", "std", "prior_fraction")
        },
        "kernels": base64.b64encode(kernels.tobytes()).decode(),
        "kernel_peaks": _packed(diagnostics["psf_peak"].values),
        "colours": {"sequential": _colours(SEQUENTIAL), "diverging": _colours(DIVERGING)},
    }


def _range(values: Float[np.ndarray, " pixels"], unit: str) -> dict[str, object]:
    low, high = np.percentile(values, [0.5, 99.5])
    return {"unit": unit, "low": low, "high": high, "log": False, "colours": "sequential"}


def _packed(values: np.ndarray) -> str:
    return base64.b64encode(np.asarray(values, dtype="<f4").tobytes()).decode()


def _colours(name: str) -> str:
    return base64.b64encode(colormaps[name](np.arange(256), bytes=True)[:, :3].tobytes()).decode()
