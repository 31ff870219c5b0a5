"""The page's own arithmetic: pixels, coordinates, point-spread functions, ticks, channels.

Scripts of a page are run in node, with a document that only keeps what is set.
"""

import json
import re
import shutil
import subprocess
from pathlib import Path

import astropy.units as u
import healpy
import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from matplotlib.colors import Normalize
from reference_linear import resolution_rows

import lusee_bayes as lb
from lusee_bayes.core.harmonics import mode_numbers, pixel_matrix, synthesis_matrix, to_healpy
from lusee_bayes.report.figures import drawing
from lusee_bayes.report.viewer import BUDGET, KERNEL_NSIDE, nside_of_page
from lusee_bayes.results.finished_runs import read_channels

NODE = shutil.which("node")
HERE = Path(__file__).parent
DOCUMENT = (HERE / "document.js").read_text()
_, *PARTS = re.split("// === ([a-z]+)\n", (HERE / "on_the_page.js").read_text())
PARTS = dict(zip(PARTS[::2], PARTS[1::2], strict=True))
SIZES = {"viewer-map": [400, 200], "viewer-psf": [120, 60]}


def run_page(page: str, tmp_path, commands: str) -> dict:
    """What ``commands`` leave in ``told`` after the scripts of the page have run."""
    embedded = r'<script type="application/json" id="viewer-data">(.*?)</script>'
    (data,) = re.findall(embedded, page, re.DOTALL)
    scripts = re.findall(r"<script>\n(.*?)\n</script>", page, re.DOTALL)
    given = f"element('viewer-data').textContent = {json.dumps(data)};"
    last = "require('fs').writeFileSync('told.json', JSON.stringify(told));"
    text = [DOCUMENT, given, *scripts, "const told = {};", commands, last]
    (tmp_path / "page.js").write_text("\n".join(text).replace("SIZES", json.dumps(SIZES), 1))
    subprocess.run([NODE, "page.js"], cwd=tmp_path, check=True, timeout=120)
    return json.loads((tmp_path / "told.json").read_text())


needs_node = pytest.mark.skipif(NODE is None, reason="no node on this machine")
POINTS = [(0.0, 0.0), (280.0, -32.0), (123.4, 56.7), (33.0, -89.0), (180.0, 90.0)]


@pytest.fixture(scope="module")
def page(small_map):
    return (small_map.folder / "report.html").read_text()


@needs_node
def test_pixels_and_equatorial_coordinates(page, small_map, tmp_path):
    rng = np.random.default_rng(3)
    lon, lat = rng.uniform(0, 360, 300), np.degrees(np.arcsin(rng.uniform(-1, 1, 300)))
    points = json.dumps(np.stack([lon, lat], 1).tolist())
    commands = f"told.at = {points}.map((p) => viewer.at(...p));"
    commands += f"told.pixels = {points}.map((p) => viewer.pixel(...p));"
    found = run_page(page, tmp_path, commands)
    np.testing.assert_array_equal(found["pixels"], healpy.ang2pix(64, lon, lat, lonlat=True))
    told, icrs = found["at"], SkyCoord(lon, lat, unit="deg", frame="galactic").icrs
    found = SkyCoord([x["ra"] for x in told], [x["dec"] for x in told], unit="deg")
    # the rotation is kept with 16 digits; asin near the poles loses half of them
    assert found.separation(icrs).max() < 1e-5 * u.deg


@needs_node
def test_maps_are_those_of_the_files_at_nside_64(page, small_map, tmp_path):
    """Coefficients by healpy's own synthesis; pixels by its interpolation; a file that it reads."""
    names = ("mean", "truth", "draw2", "std", "prior_fraction", "pull")
    commands = f"for (const name of {json.dumps(names)}) told[name] = viewer.map(name);"
    commands += """for (const layer of ["mean", "residual"]) {
      elements["viewer-layer"].value = layer; elements["viewer-layer"].listeners.change();
      require("fs").writeFileSync(`${layer}.fits`, Buffer.concat(viewer.fits()));
    } told.mean_at = viewer.at(96, 30).mean;"""
    got = {name: np.array(x) for name, x in run_page(page, tmp_path, commands).items()}
    channel = small_map.result.channel
    skies = {"mean": channel.mean, "truth": channel.truth, "draw2": channel.details.draws[1]}
    maps = {name: healpy.alm2map(to_healpy(modes), 64, lmax=8) for name, modes in skies.items()}
    for name, expected in maps.items():  # single precision
        np.testing.assert_allclose(got[name], expected, rtol=0, atol=1e-6 * expected.max())
    theta, phi = healpy.pix2ang(64, np.arange(12 * 64**2))
    pixels = {"std": channel.pixel_std, "prior_fraction": channel.details.prior_fraction}
    for name, coarse in pixels.items():  # half a step of 65535
        maps[name] = healpy.get_interp_val(coarse, theta, phi)
        np.testing.assert_allclose(got[name], maps[name], rtol=0, atol=1e-5 * np.ptp(coarse))
    pull = (maps["mean"] - maps["truth"]) / maps["std"]
    np.testing.assert_allclose(got["pull"], pull, rtol=0, atol=1e-3 * np.abs(pull).max())
    np.testing.assert_array_equal(healpy.read_map(tmp_path / "mean.fits"), got["mean"])
    percent = 100.0 * (maps["mean"] - maps["truth"]) / maps["mean"].mean()
    saved, header = healpy.read_map(tmp_path / "residual.fits", h=True)
    np.testing.assert_allclose(saved, percent, rtol=0, atol=1e-3)
    assert dict(header)["COORDSYS"] == "G"
    y = synthesis_matrix(np.array([np.pi / 3]), np.radians([96.0]), 8)
    assert got["mean_at"] == pytest.approx(float(y[0] @ channel.mean), rel=1e-6)


PAGES = ["small_map", pytest.param("correlated", marks=pytest.mark.essential)]


@needs_node
@pytest.mark.parametrize("which", PAGES)
def test_point_spread_functions_are_those_of_the_posterior(which, request, tmp_path):
    """Against y^T R from the posterior; bytes are wrong by half a step at most, at random."""
    run = request.getfixturevalue(which)
    commands = f"told.kernels = {json.dumps(POINTS)}.map((p) => viewer.kernel(...p));"
    page = (run.folder / "report.html").read_text()
    kernels = np.array(run_page(page, tmp_path, commands)["kernels"])
    lon, lat = np.radians(POINTS).T
    y, there = synthesis_matrix(np.pi / 2 - lat, lon, 8), pixel_matrix(KERNEL_NSIDE, 8)
    posterior = lb.infer(lb.build(run.result.scenario)).posterior
    expected = np.asarray(resolution_rows(posterior, y)) @ there.T
    (channel,) = read_channels(run.folder / "diagnostics.nc")
    ell, _ = mode_numbers(8)
    details = channel.details
    step, width = details.resolution_step[np.ix_(ell, ell)], details.prior_width
    variance = (y * width) ** 2 @ (step**2 / 12) @ ((there / width) ** 2).T
    # entries of the two triangles are the same number: errors may add, sqrt(2) at most
    assert (np.abs(kernels - expected) < 6 * np.sqrt(2 * variance) + 1e-6 * expected.max()).all()
    assert np.abs(kernels - expected).max() < 0.03 * np.abs(expected).max()


@needs_node
def test_what_a_direction_and_the_pointer_tell(page, tmp_path):
    told = run_page(page, tmp_path, PARTS["pointer"])
    # of each row the name and the value
    told["rows"] = dict(zip(told["rows"][::2], told["rows"][1::2], strict=True))
    assert {"right ascension, declination (ICRS)", "ever above the horizon"} <= set(told["rows"])
    assert any(name.startswith("region of ") for name in told["rows"])
    assert told["hover"].startswith("posterior mean: ") and "RA, Dec" in told["hover"]
    # the Galactic centre is at 266.4, -28.9 degrees
    assert "266.4" in told["hover"] and "-28.9" in told["hover"]
    assert {"Cas A", "Cyg A", "60°", "-30°"} <= set(told["texts"])
    layers = {"mean", "std", "truth", "residual", "pull", "prior_fraction", "draw1"}
    assert layers <= set(told["options"])
    assert told["ticks"] == [[1, 10, 100, 1000], [-4, -2, 0, 2, 4], [4000, 5000, 6000]]
    # the ellipse fills pi/4 of its rectangle, and more of it when zoomed in
    assert told["seen"] == pytest.approx([400 * 200 * np.pi / 4, 120 * 60 * np.pi / 4], rel=0.02)
    assert told["zoomed"] > told["seen"][0]


LMAX = 8
RUNS = "observation.runs=[{cycles: 0.1}, {cycles: 0.1, turntable_deg: 30}]"


@pytest.fixture(scope="module")
def correlated(tmp_path_factory):
    scenario = lb.load_scenario("fiducial", [f"lmax={LMAX}", RUNS, "prior.model=local_scales"])
    return lb.run_map(scenario, tmp_path_factory.mktemp("correlated") / "map")


@needs_node
def test_channels_of_the_page_are_those_of_the_files(small_cube, tmp_path):
    page, rng = (small_cube.folder / "report.html").read_text(), np.random.default_rng(3)
    lon, lat = rng.uniform(0, 360, 40), np.degrees(np.arcsin(rng.uniform(-1, 1, 40)))
    points = json.dumps(np.stack([lon, lat], 1).tolist())
    told = run_page(page, tmp_path, f"const points = {points};" + PARTS["channels"])
    # the slider, and every selector of the page, choose the channel that is told of
    assert told["hidden"] == [True, True, False] and told["chosen"] == [1, 1]
    assert told["shown"] == [False, True, False]
    y = synthesis_matrix(np.pi / 2 - np.radians(lat), np.radians(lon), 4)
    for k, channel in enumerate(small_cube.result.channels):
        got = {name: np.array([one[name] for one in told["at"][k]]) for name in told["at"][k][0]}
        for name in ("mean", "truth"):
            expected = y @ getattr(channel, name)
            np.testing.assert_allclose(got[name], expected, rtol=0, atol=1e-6 * expected.max())
        std = healpy.get_interp_val(channel.pixel_std, lon, lat, lonlat=True)
        # half a step, and what rounding adds
        assert (np.abs(got["std"] - std) <= 0.501 * np.ptp(channel.pixel_std) / 65535).all()
    assert told["texts"] == ["20 MHz", "30 MHz"]
    assert told["options"] == ["mean", "std", "truth", "residual", "pull"]
    assert "30 MHz" in told["rows"]


@needs_node
@pytest.mark.parametrize("which", ["small_map", "small_cube"])
def test_keys_move_the_direction_and_parts_are_those_that_the_page_has(which, request, tmp_path):
    page = (request.getfixturevalue(which).folder / "report.html").read_text()
    many = which == "small_cube"
    assert ('id="viewer-channel"' in page, 'id="viewer-spectrum"' in page) == (many, many)
    assert ('id="viewer-psf"' in page) != many and ('class="channel"' in page) == many
    told = run_page(page, tmp_path, PARTS["keys"])
    assert told["places"] == [[0, 0], [2, 0], [2, 2], [0, 2], [0, 0]]
    assert "30.00°, -45.00°" in told["rows"]
    assert ("peak of the point-spread function" in told["rows"]) != many


def test_a_sky_below_zero_has_a_linear_scale():
    scale = drawing.temperatures(np.linspace(-2.0, -1.0, 24))
    assert type(scale) is Normalize and -2.0 <= scale.vmin < scale.vmax <= -1.0


def test_the_rim_is_a_circle_about_the_pole_that_never_sets():
    """A site on a fixed axis sees all within 90 degrees + |latitude| of one pole of the Moon."""
    angles = np.array(healpy.pix2ang(16, np.arange(3072)))
    line = np.concatenate(drawing.rim(np.cos(healpy.rotator.angdist([0.5, 1.0], angles)) + 0.9))
    apart = healpy.rotator.angdist([0.5, 1.0], np.radians([90.0 - line[:, 1], line[:, 0]]))
    # bilinear in pixels of 3.7 degrees
    np.testing.assert_allclose(np.cos(apart), -0.9, atol=0.01)


def test_pages_stay_within_their_size():
    assert nside_of_page(32, 9) == 32
    for nside, n_maps in ((64, 138), (64, 1383), (32, 30)):
        shown = nside_of_page(nside, n_maps)
        assert 24 * shown**2 * n_maps <= BUDGET
        assert shown == nside or 24 * (2 * shown) ** 2 * n_maps > BUDGET
