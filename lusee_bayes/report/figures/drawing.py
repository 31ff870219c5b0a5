"""Colours, axes and Galactic Mollweide maps for all figures.

A view of a map is a picture of fixed size. The pixels that contribute to each of its points are
computed once per NSIDE; drawing a map then sums four numbers per point.

Maps are drawn with a Gaussian beam, because a map truncated at lmax rings: next to the Galactic
plane, a truth with lmax = 47 drops to half of the real sky, and one with lmax = 24 below zero. A
beam that falls to a tenth at lmax reduces the rings to the per cent level. It affects only the
figures; files and numbers are unsmoothed.
"""

import re
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache
from pathlib import Path

import numpy as np
from contourpy import contour_generator
from jaxtyping import Float
from matplotlib import cm, colormaps, colors, patches, patheffects, ticker
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colorbar import Colorbar
from matplotlib.figure import Figure
from matplotlib.image import AxesImage, imsave
from matplotlib.text import Text

from lusee_bayes.core import lazy, version
from lusee_bayes.core.arrays import Pixels
from lusee_bayes.core.harmonics import lmax_of, modes_to_map, per_mode, taper
from lusee_bayes.instrument.beams.fields import HemisphereGrid

# safe for colour-blind readers: perceptually uniform, and a blue-orange pair (Okabe-Ito) for lines
SEQUENTIAL, DIVERGING = "inferno", "PuOr_r"
BLUE, ORANGE, GREY = "#0072B2", "#D55E00", "#666666"
# distinct without colour vision (Okabe-Ito), and by their lines
COLOURS = (BLUE, ORANGE, "#009E73", "#CC79A7", "#56B4E9", "#000000")
LINES = ("-", "--", "-.", ":")
# a map whose pixels may be larger than those of the map drawn
Coarse = Float[np.ndarray, " coarse_pixels"]
# width and height in inches
Size = tuple[float | int, float | int]
# of PNGs: files are a fifth larger than with 6, and written in a third of the time
COMPRESSION = 2


def save(figures: Iterable[tuple[Path, Figure]], dpi: int) -> None:
    """Write figures as PNGs, drawing each once (savefig would draw it twice).

    While one is compressed, the next is drawn.
    """
    options = {"format": "png", "dpi": dpi, "pil_kwargs": {"compress_level": COMPRESSION}}
    with ThreadPoolExecutor(1) as other:
        drawn = ((path, _drawn(figure, dpi)) for path, figure in figures)
        written = [other.submit(imsave, path, image, **options) for path, image in drawn]
    for one in written:
        one.result()


def _drawn(figure: Figure, dpi: int) -> memoryview:
    """The pixels of a figure."""
    figure.set_dpi(dpi)
    for text in figure.findobj(Text):
        text.set_text(version.printable(text.get_text()))
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return canvas.buffer_rgba()


def named_parts(name: str, drawn: Figure | dict[str, Figure] | None) -> dict[str, Figure]:
    """Figures by file name: ``maps``, or ``maps_1_truth`` and so on if there are several."""
    if not isinstance(drawn, dict):
        return {} if drawn is None else {name: drawn}
    numbered = zip([re.sub(r"[^\w.]+", "_", title) for title in drawn], drawn.values(), strict=True)
    return {f"{name}_{k}_{title}": figure for k, (title, figure) in enumerate(numbered, 1)}


def framed(size: Size, rows: int = 1, columns: int = 1, **options: object):
    """Make a figure with one or an array of axes, in a constrained layout."""
    figure = Figure(figsize=size, layout="constrained")
    return figure, figure.subplots(rows, columns, **options)


def in_places(
    size: Size, rows: int = 1, columns: int = 1, **places: float
) -> tuple[Figure, list[Axes]]:
    """Make a figure with axes in fixed places, which needs no layout."""
    figure = Figure(figsize=size)
    return figure, list(figure.subplots(rows, columns, gridspec_kw=places, squeeze=False).flat)


def temperatures(pixels: Float[np.ndarray, "..."], lowest: float = 0.05) -> colors.Normalize:
    """A logarithmic scale over all positive pixels, from percentile ``lowest`` to 99.8.

    Linear if no pixel is positive.
    """
    positive = pixels[pixels > 0]
    bounds = np.percentile(positive if positive.size else pixels, [lowest, 99.8])
    return colors.LogNorm(*bounds) if positive.size else colors.Normalize(*bounds)


def seen_range(std: Float[np.ndarray, "..."], altitude: Pixels) -> tuple[float, float]:
    """Bounds of a logarithmic scale for standard deviations, from the observed region.

    A cap that never rose has standard deviations that would hide the structure of the rest. The few
    per cent next to its rim have the brightest colour, too.

    Parameters
    ----------
    std : (..., pixels) array
    altitude : (pixels,) array
        sin of the highest altitude of each pixel.
    """
    seen = std[..., altitude >= 0] if (altitude >= 0).any() else std
    low, high = np.percentile(seen, [0.5, 97.0])
    return float(low), float(max(high, 1.01 * low))


def plain_ticks(axes: Axes, n: int = 4) -> None:
    """At most ``n`` ticks on each axis, labelled with full numbers instead of an offset."""
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(ticker.MaxNLocator(n))
        axis.set_major_formatter(ticker.StrMethodFormatter("{x:,.8g}"))


def side_by_side(axes: Axes, data: Float[np.ndarray, "n times"], products: Sequence[str]) -> None:
    """Draw products side by side, time running within each."""
    n_times = data.shape[1]
    starts = np.arange(0, data.size, n_times)
    axes.plot(data.ravel(), color=BLUE, lw=0.7)
    for start in starts:
        axes.axvline(start, color=GREY, lw=0.4)
    axes.set_xticks(starts + 0.5 * n_times, products, fontsize=8)
    axes.tick_params(axis="x", length=0)
    axes.set(xlabel="product (time runs within each)", ylabel="visibility [K]", xlim=(0, data.size))


def orthographic(axes: Axes, grid: HemisphereGrid, pattern: Float[np.ndarray, "theta phi"]):
    """Draw a pattern on the plane of the horizon: x East, y North."""
    phi = np.append(grid.phi, 2 * np.pi)
    closed = np.concatenate([pattern, pattern[:, :1]], axis=1) / pattern.max()
    # the grid has no node at the zenith: use the mean over azimuth of the first ring
    closed = np.concatenate([np.full((1, closed.shape[1]), closed[0].mean()), closed])
    x, y = (np.outer(np.sin(np.append(0.0, grid.theta)), f(phi)) for f in (np.cos, np.sin))
    style = {"cmap": SEQUENTIAL, "vmin": 0, "vmax": 1, "shading": "gouraud", "rasterized": True}
    image = axes.pcolormesh(x, y, closed, **style)
    axes.set(aspect="equal", xticks=[], yticks=[], xlim=(-1.15, 1.15), ylim=(-1.15, 1.15))
    axes.add_artist(patches.Circle((0, 0), 1.0, fill=False, color=GREY, lw=0.8))
    points = {"N": (0, 1.08), "E": (1.08, 0), "S": (0, -1.08), "W": (-1.08, 0)}
    for name, (px, py) in points.items():
        axes.text(px, py, name, ha="center", va="center", fontsize=8)
    axes.set_frame_on(False)
    return image


def colour_bar(
    figure: Figure, image: cm.ScalarMappable, axes: Axes | list[Axes], **options: object
) -> Colorbar:
    """A colour bar; a logarithmic one has plain numbers, and more ticks if it is narrow."""
    bar = figure.colorbar(image, ax=axes, **options)
    if isinstance(image.norm, colors.LogNorm):
        narrow = image.norm.vmax < 20.0 * image.norm.vmin
        subs = (1.0, 1.5, 2.0, 3.0, 5.0, 7.0) if narrow else (1.0, 2.0, 5.0)
        bar.set_ticks(ticker.LogLocator(subs=subs), minor=False)
        bar.set_ticks([], minor=True)
        bar.long_axis.set_major_formatter(lambda value, _: f"{value:,.6g}")
    return bar


def note(title: str, text: str) -> Figure:
    """Make a figure that states why nothing is drawn."""
    figure = Figure(figsize=(8, 1.6), layout="constrained")
    figure.suptitle(title)
    figure.text(0.5, 0.35, text, ha="center")
    return figure


# points of a view from left to right, as in a map on paper or screen
WIDTH = 720
# half the axes of the ellipse
EDGE = (2.0, 1.0)
# visible on dark and on light maps
SEEN_ANYWHERE = [patheffects.withStroke(linewidth=2.4, foreground="white", alpha=0.7)]
MERIDIANS, PARALLELS = (120.0, 60.0, 0.0, -60.0, -120.0), (-60.0, -30.0, 0.0, 30.0, 60.0)


def mollweide(
    axes: Axes,
    pixels: Pixels,
    *,
    norm: colors.Normalize,
    cmap: str = SEQUENTIAL,
    highest_altitude: Coarse | None = None,
) -> AxesImage:
    """Draw a Galactic HEALPix RING map: centre l = 0, longitude grows to the left.

    ``highest_altitude`` adds a dashed line round the region that never rose.
    """
    # negative temperatures have no logarithm: use the darkest colour; what is undefined is grey
    bad = colormaps[cmap](0.0) if isinstance(norm, colors.LogNorm) else "lightgrey"
    colours = colormaps[cmap].with_extremes(bad=bad)
    rim = patches.Ellipse((0.0, 0.0), 2 * EDGE[0], 2 * EDGE[1], fill=False, color="black", lw=0.8)
    extent = (-EDGE[0], EDGE[0], -EDGE[1], EDGE[1])
    style = {"origin": "lower", "cmap": colours, "norm": norm, "aspect": "equal"}
    image = axes.imshow(view(pixels), extent=extent, **style)
    axes.add_patch(rim)
    image.set_clip_path(rim)
    if highest_altitude is not None and (highest_altitude < 0).any():
        style = {"colors": "black", "linestyles": "dashed", "linewidths": 1.2}
        line = axes.contour(view(highest_altitude), [0.0], extent=extent, **style)
        line.set_path_effects(SEEN_ANYWHERE)
        line.set_clip_path(rim)
    _graticule(axes)
    axes.set(xlim=(-1.09 * EDGE[0], 1.02 * EDGE[0]), ylim=(-1.03 * EDGE[1], 1.03 * EDGE[1]))
    axes.set_axis_off()
    return image


def sky_panel(
    axes: Axes,
    title: str,
    pixels: Pixels,
    norm: colors.Normalize,
    cmap: str = SEQUENTIAL,
    unit: str = "K",
    *,
    altitude: Coarse | None = None,
    **bar: object,
) -> None:
    """Draw a map (:func:`mollweide`) with its title and a colour bar."""
    image = mollweide(axes, pixels, norm=norm, cmap=cmap, highest_altitude=altitude)
    colour_bar(axes.figure, image, axes, label=unit, extend="both", **bar)
    axes.set_title(title)


def sky_figure(title: str, *panel: object, **options: object) -> Figure:
    """A figure of one :func:`sky_panel`, as wide as a phone or half a page."""
    figure, (axes,) = in_places((6.4, 3.0), left=0.01, right=0.97, bottom=0.02, top=0.9)
    sky_panel(axes, title, *panel, shrink=0.8, pad=0.03, **options)
    return figure


def sky_figures(panels: Mapping[str, tuple], altitude: Coarse) -> dict[str, Figure]:
    """A :func:`sky_figure` of each panel, by its title."""
    return {t: sky_figure(t, *panel, altitude=altitude) for t, panel in panels.items()}


def view(pixels: Pixels) -> Float[np.ndarray, "height width"]:
    """Interpolate a map at every point of the view.

    Parameters
    ----------
    pixels : (pixels,) array
        A Galactic map in HEALPix RING order.

    Returns
    -------
    (height, width) array
        From the South pole up, and from l = 180 degrees at the left; points beyond the rim have the
        rim's values.
    """
    neighbours, weights = _projection(lazy.healpy.npix2nside(len(pixels)))
    return np.einsum("kp,kp->p", weights, np.asarray(pixels)[neighbours]).reshape(WIDTH // 2, WIDTH)


@lru_cache(maxsize=4)
def _projection(nside: int) -> tuple[np.ndarray, np.ndarray]:
    """The four pixels next to every point of the view, and their weights."""
    x = (np.arange(WIDTH) + 0.5) / WIDTH * 2.0 - 1.0
    y = (np.arange(WIDTH // 2) + 0.5) / (WIDTH // 2) * 2.0 - 1.0
    x, y = (grid.ravel() for grid in np.meshgrid(x, y))
    return lazy.healpy.get_interp_weights(nside, *unprojected(x, y), lonlat=True)


def unprojected(
    x: Float[np.ndarray, " points"], y: Float[np.ndarray, " points"]
) -> tuple[Float[np.ndarray, " points"], Float[np.ndarray, " points"]]:
    """Find the directions of points of the view.

    With y = sin t: sin(latitude) = (2 t + sin 2 t) / pi, longitude = -180 degrees x / cos t.

    Parameters
    ----------
    x, y : (points,) array
        From -1 to 1; points beyond the rim are moved to it.

    Returns
    -------
    lon_deg, lat_deg : (points,) array
        In degrees.
    """
    t = np.arcsin(y)
    lat = np.arcsin((2.0 * t + np.sin(2.0 * t)) / np.pi)
    return -180.0 * np.clip(x / np.cos(t), -1.0, 1.0), np.degrees(lat)


def rim(highest_altitude: Pixels) -> list[Float[np.ndarray, "points 2"]]:
    """Lines round the region that never rose, as points (l, b) in degrees.

    Parameters
    ----------
    highest_altitude : (pixels,) array
        sin of the highest altitude of each pixel.
    """
    lon, lat = np.linspace(-180.0, 180.0, 361), np.linspace(-90.0, 90.0, 181)
    heights = lazy.healpy.get_interp_val(highest_altitude, *np.meshgrid(lon, lat), lonlat=True)
    return contour_generator(lon, lat, heights).lines(0.0)


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
    # excluded from the layout, which need not measure them
    style = {"fontsize": 7, "va": "center", "in_layout": False}
    for lon in MERIDIANS:
        label = axes.text(-EDGE[0] * lon / 180.0, 0.06, f"{lon % 360:.0f}°", ha="center", **style)
        label.set_path_effects(SEEN_ANYWHERE)
    for lat, x, y in zip(PARALLELS, ends, heights, strict=True):
        axes.text(-EDGE[0] * x - 0.05, EDGE[1] * y, f"{lat:.0f}°", ha="right", **style)


def shown(modes: Float[np.ndarray, " modes"], nside: int, lmax: int | None = None) -> Pixels:
    """Synthesise the HEALPix RING map of packed coefficients, smoothed with a map's beam.

    ``lmax`` is that of the map to which the beam belongs, by default that of the coefficients.
    """
    top = lmax_of(len(modes))
    return modes_to_map(modes * per_mode(taper(top if lmax is None else lmax, top)), nside)
