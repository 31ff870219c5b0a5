"""The page's own arithmetic, run in node: pixels, coordinates, point-spread functions, ticks."""

from __future__ import annotations

import json

import astropy.units as u
import healpy
import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from page_in_node import NODE, run_page
from reference_linear import resolution_rows

from lusee_bayes.core.harmonics import mode_numbers, pixel_matrix, synthesis_matrix
from lusee_bayes.core.lazy import healpy as lazy_healpy
from lusee_bayes.report.explorer import KERNEL_NSIDE, std_scale
from lusee_bayes.results.diagnostics import packed_resolution, read_diagnostics
from lusee_bayes.sky.prior import IndependentPrior

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
    told = run_page(page, tmp_path, f"told.at = {points}.map((p) => explorer.at(...p));")["at"]
    nside = small_map.result.channel.nside
    expected = healpy.ang2pix(nside, lon, lat, lonlat=True)
    np.testing.assert_array_equal([one["pixel"] for one in told], expected)
    icrs = SkyCoord(lon, lat, unit="deg", frame="galactic").icrs
    found = SkyCoord([x["ra"] for x in told], [x["dec"] for x in told], unit="deg")
    # the rotation is kept with 16 digits; asin near the poles loses half of them
    assert found.separation(icrs).max() < 1e-5 * u.deg


@needs_node
def test_point_spread_functions_are_those_of_the_posterior(page, small_map, tmp_path):
    """Against y^T R from the posterior; bytes are wrong by half a step at most, at random."""
    commands = f"told.kernels = {json.dumps(POINTS)}.map((p) => explorer.kernel(...p));"
    kernels = np.array(run_page(page, tmp_path, commands)["kernels"])
    lon, lat = np.radians(POINTS).T
    y = synthesis_matrix(np.pi / 2 - lat, lon, 8)
    there = pixel_matrix(KERNEL_NSIDE, 8)
    expected = np.asarray(resolution_rows(small_map.result.inference.posterior, y)) @ there.T
    found = read_diagnostics(small_map.folder / "diagnostics.nc")
    ell, _ = mode_numbers(8)
    step, width = found["resolution_step"].values[np.ix_(ell, ell)], found["prior_std"].values
    variance = (y * width) ** 2 @ (step**2 / 12) @ ((there / width) ** 2).T
    # entries of the two triangles are the same number: errors may add, sqrt(2) at most
    assert (np.abs(kernels - expected) < 6 * np.sqrt(2 * variance) + 1e-6 * expected.max()).all()
    # and that is little
    assert np.abs(kernels - expected).max() < 0.02 * np.abs(expected).max()


def test_the_resolution_matrix_is_packed_by_its_definition():
    rng = np.random.default_rng(1)
    prior = np.array([50.0, *rng.uniform(1, 2, 8)])
    root = rng.standard_normal((9, 9)) * 0.1
    covariance = root @ root.T
    packed, steps = packed_resolution(covariance, IndependentPrior(prior))
    ell, _ = mode_numbers(2)
    white = packed * steps[np.ix_(ell, ell)]
    r = np.diag(prior) @ white @ np.diag(1 / prior)
    exact = np.eye(9) - covariance / prior[None, :] ** 2
    half = 0.5 * steps[np.ix_(ell, ell)] * prior[:, None] / prior[None, :]
    assert (np.abs(r - exact) <= half * (1 + 1e-9)).all()
    np.testing.assert_array_equal(packed, packed.T)


@needs_node
def test_what_a_direction_and_the_pointer_tell(page, tmp_path):
    told = run_page(
        page,
        tmp_path,
        """explorer.choose(280, -30);
        told.rows = elements["explorer-values"].rows.map((one) => one.textContent);
        elements["explorer-map"].listeners.pointermove({ clientX: 200, clientY: 100, buttons: 0 });
        told.hover = elements["explorer-hover"].textContent;
        told.texts = elements["explorer-map"].texts;
        told.options = elements["explorer-layer"].options.map((one) => one.value);
        told.ticks = [explorer.ticks(1, 1000, true), explorer.ticks(-4, 4, false),
          explorer.ticks(3700, 6300, true)];
        const seen = (id) => elements[id].image.data.filter((x, k) => k % 4 === 3 && x).length;
        told.seen = [seen("explorer-map"), seen("explorer-psf")];
        elements["explorer-in"].listeners.click();
        told.zoomed = seen("explorer-map");""",
    )
    assert "right ascension, declination (ICRS)" in told["rows"]
    assert told["hover"].startswith("posterior mean: ") and "RA, Dec" in told["hover"]
    # the Galactic centre is at 266.4, -28.9 degrees
    assert "266.4" in told["hover"] and "-28.9" in told["hover"]
    assert {"Cas A", "Cyg A", "60°", "-30°"} <= set(told["texts"])
    assert {"mean", "std", "truth", "residual", "pull"} <= set(told["options"])
    assert told["ticks"] == [
        [1, 10, 100, 1000],
        [-4, -2, 0, 2, 4],
        [4000, 5000, 6000],
    ]
    # the ellipse fills pi/4 of its rectangle, and more of it when zoomed in
    assert told["seen"] == pytest.approx([400 * 200 * np.pi / 4, 120 * 60 * np.pi / 4], rel=0.02)
    assert told["zoomed"] > told["seen"][0]


def test_standard_deviations_show_what_was_seen():
    """The scale leaves out the cap that never rose, however large its standard deviation."""
    n = lazy_healpy.nside2npix(8)
    altitude = np.where(np.arange(n) < 100, -0.1, 0.5)
    std = np.where(altitude < 0, 1e4, np.linspace(10.0, 30.0, n))
    scale = std_scale(std, altitude)
    assert scale["log"] and 10.0 <= scale["low"] < scale["high"] <= 30.0
