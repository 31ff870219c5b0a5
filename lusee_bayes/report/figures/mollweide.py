"""Galactic Mollweide views of HEALPix maps.

A view is a picture of fixed size: which pixels make up each of its points is worked out once for
all maps of one NSIDE, and a map is then a sum of four numbers a point.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from jaxtyping import Float
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.colors import Normalize
from matplotlib.image import AxesImage
from matplotlib.patches import Ellipse
from matplotlib.patheffects import withStroke

from lusee_bayes.core.lazy import healpy
from lusee_bayes.report.figures.drawing import SEQUENTIAL

# points of a view from left to right: as many as a map of a figure has on paper or screen
WIDTH = 720
# half the axes of the ellipse
EDGE = (2.0, 1.0)
# seen on dark maps and on light ones
SEEN_ANYWHERE = [withStroke(linewidth=2.4, foreground="white", alpha=0.7)]
MERIDIANS, PARALLELS = (120.0, 60.0, 0.0, -60.0, -120.0), (-60.0, -30.0, 0.0, 30.0, 60.0)


def mollweide(
    axes: Axes,
    pixels: Float[np.ndarray, " pixels"],
    *,
    norm: Normalize,
    cmap: str = SEQUENTIAL,
    highest_altitude: Float[np.ndarray, " pixels"] | None = None,
) -> AxesImage:
    """Draw a Galactic HEALPix RING map: centre l = 0, longitude grows to the left.

    ``highest_altitude``: draws a dashed line round the region that never rose.
    """
    # negative temperatures have no logarithm: they take the darkest colour
    colours = colormaps[cmap].with_extremes(bad=colormaps[cmap](0.0))
    rim = Ellipse((0.0, 0.0), 2 * EDGE[0], 2 * EDGE[1], fill=False, color="black", lw=0.8)
    extent = (-EDGE[0], EDGE[0], -EDGE[1], EDGE[1])
    image = axes.imshow(
        view(pixels), extent=extent, origin="lower", cmap=colours, norm=norm, aspect="equal"
    )
    axes.add_patch(rim)
    image.set_clip_path(rim)
    if highest_altitude is not None and (highest_altitude < 0).any():
        line = axes.contour(
            view(highest_altitude),
            [0.0],
            extent=extent,
            colors="black",
            linestyles="dashed",
            linewidths=1.2,
        )
        line.set_path_effects(SEEN_ANYWHERE)
        line.set_clip_path(rim)
    _graticule(axes)
    axes.set(xlim=(-1.09 * EDGE[0], 1.02 * EDGE[0]), ylim=(-1.03 * EDGE[1], 1.03 * EDGE[1]))
    axes.set_axis_off()
    return image


def view(pixels: Float[np.ndarray, " pixels"]) -> Float[np.ndarray, "height width"]:
    """Interpolate a map at every point of the view.

    Parameters
    ----------
    pixels : (pixels,) array
        A Galactic map in HEALPix RING order.

    Returns
    -------
    (height, width) array
        From the South pole up, and from l = 180 degrees at the left; beyond the rim the map goes
        on with the rim's own values.
    """
    neighbours, weights = _projection(healpy.npix2nside(len(pixels)))
    values = np.einsum("kp,kp->p", weights, np.asarray(pixels)[neighbours])
    return values.reshape(WIDTH // 2, WIDTH)


@lru_cache(maxsize=4)
def _projection(nside: int) -> tuple[np.ndarray, np.ndarray]:
    """The four pixels next to every point of the view, and their weights."""
    x = (np.arange(WIDTH) + 0.5) / WIDTH * 2.0 - 1.0
    y = (np.arange(WIDTH // 2) + 0.5) / (WIDTH // 2) * 2.0 - 1.0
    x, y = (grid.ravel() for grid in np.meshgrid(x, y))
    lon, lat = unprojected(x, y)
    neighbours, weights = healpy.get_interp_weights(nside, lon, lat, lonlat=True)
    return neighbours, weights


def unprojected(
    x: Float[np.ndarray, " points"], y: Float[np.ndarray, " points"]
) -> tuple[Float[np.ndarray, " points"], Float[np.ndarray, " points"]]:
    """Find the directions of points of the view.

    With y = sin t: sin(latitude) = (2 t + sin 2 t) / pi, longitude = -180 degrees x / cos t.

    Parameters
    ----------
    x, y : (points,) array
        From -1 to 1; points beyond the rim are taken to lie on it.

    Returns
    -------
    lon_deg, lat_deg : (points,) array
        In degrees.
    """
    t = np.arcsin(y)
    lat = np.arcsin((2.0 * t + np.sin(2.0 * t)) / np.pi)
    inside = np.clip(x / np.cos(t), -1.0, 1.0)
    return -180.0 * inside, np.degrees(lat)


def _graticule(axes: Axes) -> None:
    """Lines of equal longitude and latitude, with their degrees."""
    t = np.linspace(-np.pi / 2.0, np.pi / 2.0, 181)
    lines = [(-lon / 180.0 * np.cos(t), np.sin(t)) for lon in MERIDIANS]
    heights = np.sin(np.interp(PARALLELS, unprojected(np.zeros_like(t), np.sin(t))[1], t))
    ends = np.sqrt(1.0 - heights**2)
    lines += [(np.array([-x, x]), np.array([y, y])) for x, y in zip(ends, heights, strict=True)]
    # one path with gaps is drawn faster than ten
    x, y = (np.concatenate([np.append(line[k], np.nan) for line in lines]) for k in (0, 1))
    axes.plot(EDGE[0] * x, EDGE[1] * y, color="#b0b0b0", alpha=0.4, lw=0.4)
    # their place is known: the layout need not measure them
    style = {"fontsize": 7, "va": "center", "in_layout": False}
    for lon in MERIDIANS:
        text = f"{lon % 360:.0f}°"
        label = axes.text(-EDGE[0] * lon / 180.0, 0.06, text, ha="center", **style)
        label.set_path_effects(SEEN_ANYWHERE)
    for lat, x, y in zip(PARALLELS, ends, heights, strict=True):
        axes.text(-EDGE[0] * x - 0.05, EDGE[1] * y, f"{lat:.0f}°", ha="right", **style)
