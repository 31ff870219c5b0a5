"""Maps of every channel behind a slider, with the spectrum of a direction that is pointed at."""

from __future__ import annotations

import base64
from pathlib import Path

import numpy as np
from jaxtyping import Float

from lusee_bayes.core.formats import opened
from lusee_bayes.core.layouts import Layout, Variable
from lusee_bayes.core.lazy import healpy
from lusee_bayes.report.explorer import CONTROLS, sky_furniture, with_scripts

CUBE = Layout("maps of every channel", {"maps": Variable(("channel", "pixel"))})
# what the maps of a page may take, in bytes, before base64; two bytes a number
BUDGET = 3_500_000
LEVELS = 65535
LAYOUT = f"""<div class="controls">
<label for="explorer-layer">show <select id="explorer-layer"></select></label>
<label for="explorer-channel">channel: <span id="explorer-frequency"></span>
<input id="explorer-channel" type="range" min="0" step="1" value="0"></label>
{CONTROLS}
</div>
<canvas id="explorer-map" width="1200" height="600" tabindex="0" role="img"></canvas>
<p id="explorer-hover" class="hover">&nbsp;</p>
<p>Galactic Mollweide view, centre l = 0, longitude grows to the left. Move the slider for another
channel; click for the spectrum of a direction. Double-click, the buttons or the wheel with Ctrl
zoom, dragging moves. <span id="explorer-note"></span></p>
<div class="explorer">
<div><h3>Posterior there</h3><dl id="explorer-values" aria-live="polite"></dl></div>
<div><h3>Spectrum there</h3><canvas id="explorer-spectrum" width="600" height="360" role="img"
aria-label="brightness temperature against frequency in the chosen direction"></canvas>
<p>Dots with bars: posterior mean and one standard deviation; dashes: truth, where it is known.</p>
</div></div>"""
SCRIPTS = ("sky_view.js", "cube_explorer.js")


def cube_explorer(folder: Path, frequencies_mhz: list[float]) -> str:
    """The explorer of the folder of a run of several frequencies."""
    return with_scripts(LAYOUT, cube_data(folder, frequencies_mhz), SCRIPTS)


def cube_data(folder: Path, frequencies_mhz: list[float]) -> dict[str, object]:
    """Maps in two bytes a pixel, coarser where there are many; what cube_explorer.js reads."""
    found = {
        name: _read(folder / f"{name}.fits")
        for name in ("mean", "std", "truth")
        if (folder / f"{name}.fits").is_file()
    }
    nside = healpy.npix2nside(found["mean"].shape[1])
    shown = nside_of_page(nside, len(found) * len(frequencies_mhz))
    maps = {name: np.stack([_coarser(m, shown) for m in cube]) for name, cube in found.items()}
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


def _coarser(pixels: Float[np.ndarray, " pixels"], nside: int) -> Float[np.ndarray, " coarser"]:
    """Means over coarser pixels."""
    if pixels.size == 12 * nside**2:
        return pixels
    return np.asarray(healpy.ud_grade(pixels, nside))


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
