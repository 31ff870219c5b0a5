"""Mollweide views against matplotlib's own projection, and against the maps themselves."""

import healpy
import numpy as np
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.projections.geo import MollweideAxes

from lusee_bayes.report.figures.drawing import (
    EDGE,
    WIDTH,
    _projection,
    mollweide,
    unprojected,
    view,
)


def test_points_lie_where_matplotlib_puts_them():
    transform = MollweideAxes.MollweideTransform(1)
    rng = np.random.default_rng(3)
    x, y = rng.uniform(-1.0, 1.0, (2, 4000))
    inside = np.hypot(x, y) < 0.999
    lon, lat = unprojected(x[inside], y[inside])
    # matplotlib's longitude grows to the right; its ellipse is sqrt(2) times (2, 1)
    theirs = transform.transform(np.radians(np.stack([-lon, lat], axis=1)))
    # its own iteration for the latitude stops at 1e-3 radians
    expected = np.sqrt(2.0) * np.stack([2.0 * x[inside], y[inside]], axis=1)
    np.testing.assert_allclose(theirs, expected, atol=3e-3)


def test_views_have_equal_areas():
    """Mollweide keeps areas: the share of the ellipse above 30 degrees is that of the sphere."""
    y = (np.arange(100_000) + 0.5) / 50_000.0 - 1.0
    lat = unprojected(np.zeros_like(y), y)[1]
    width = np.sqrt(1.0 - y**2)
    share = width[lat > 30.0].sum() / width.sum()
    np.testing.assert_allclose(share, (1.0 - np.sin(np.radians(30.0))) / 2.0, atol=1e-4)


def test_a_map_of_longitude_and_latitude_comes_out_as_it_went_in():
    nside = 64
    lon, lat = healpy.pix2ang(nside, np.arange(12 * nside**2), lonlat=True)
    seen = {
        name: view(f)
        for name, f in {
            "x": np.cos(np.radians(lat)) * np.cos(np.radians(lon)),
            "y": np.cos(np.radians(lat)) * np.sin(np.radians(lon)),
            "z": np.sin(np.radians(lat)),
        }.items()
    }
    middle, quarter = WIDTH // 4, WIDTH // 4
    # the centre of the view is l = 0; halfway to the left l = 90 degrees; the top is the pole
    np.testing.assert_allclose(seen["x"][middle, WIDTH // 2], 1.0, atol=2e-2)
    np.testing.assert_allclose(seen["y"][middle, quarter], 1.0, atol=2e-2)
    np.testing.assert_allclose(seen["z"][-1, WIDTH // 2], 1.0, atol=2e-2)
    # a unit vector stays one, up to what bilinear interpolation loses
    length = sum(v**2 for v in seen.values())
    np.testing.assert_allclose(length, 1.0, atol=2e-3)


def test_all_maps_of_one_nside_share_one_projection():
    _projection.cache_clear()
    figure = Figure()
    for pixels in np.random.default_rng(5).normal(size=(3, 12 * 16**2)):
        mollweide(figure.add_subplot(), pixels, norm=Normalize(-1, 1), highest_altitude=pixels)
    assert _projection.cache_info().misses == 1
    assert figure.axes[0].images[0].get_extent() == [-EDGE[0], EDGE[0], -EDGE[1], EDGE[1]]
