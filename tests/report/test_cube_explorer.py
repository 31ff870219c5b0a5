"""The cube's page: every channel's maps behind the slider are those of the files."""

from __future__ import annotations

import json

import healpy
import numpy as np
import pytest
from astropy.io import fits
from page_in_node import NODE, run_page

from lusee_bayes.report.explorer import BUDGET, nside_of_page


@pytest.mark.skipif(NODE is None, reason="no node on this machine")
def test_channels_of_the_page_are_those_of_the_files(small_cube, tmp_path):
    page = (small_cube.folder / "report.html").read_text()
    rng = np.random.default_rng(3)
    lon, lat = rng.uniform(0, 360, 40), np.degrees(np.arcsin(rng.uniform(-1, 1, 40)))
    points = json.dumps(np.stack([lon, lat], 1).tolist())
    told = run_page(
        page,
        tmp_path,
        f"""told.at = [0, 1, 2].map((k) => {points}.map((p) => explorer.at(k, ...p)));
        told.texts = [0, 2].map((k) => {{
          elements["explorer-channel"].value = k;
          elements["explorer-channel"].listeners.input();
          return elements["explorer-frequency"].textContent;
        }});
        told.options = elements["explorer-layer"].options.map((one) => one.value);
        told.rows = elements["explorer-values"].rows.map((one) => one.textContent);""",
    )
    nside = small_cube.result.scenario.map_nside
    pixels = healpy.ang2pix(nside, lon, lat, lonlat=True)
    for name in ("mean", "std", "truth"):
        cube = fits.getdata(small_cube.folder / f"{name}.fits")
        step = np.ptp(cube, axis=1) / 65535
        got = np.array([[one[name] for one in channel] for channel in told["at"]])
        # half a step, and what rounding adds
        assert (np.abs(got - cube[:, pixels]) <= 0.501 * step[:, None]).all()
    assert told["texts"] == ["20 MHz", "30 MHz"]
    assert told["options"] == ["mean", "std", "truth", "residual", "pull"]
    assert "30 MHz" in told["rows"]


def test_pages_stay_within_their_size():
    assert nside_of_page(32, 9) == 32
    for nside, n_maps in ((64, 138), (64, 1383), (32, 30)):
        shown = nside_of_page(nside, n_maps)
        assert 24 * shown**2 * n_maps <= BUDGET
        assert shown == nside or 24 * (2 * shown) ** 2 * n_maps > BUDGET
