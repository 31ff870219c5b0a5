"""What figures are drawn with: colours, the projection of beams, colour bars."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Complex, Float
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.colorbar import Colorbar
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.image import imsave
from matplotlib.patches import Circle
from matplotlib.text import Text
from matplotlib.ticker import LogLocator, MaxNLocator, NullLocator

from lusee_bayes.core.version import printable
from lusee_bayes.instrument.beams import HemisphereGrid

# safe for colour-blind readers: perceptually uniform, and a blue-orange pair (Okabe-Ito) for lines
SEQUENTIAL, DIVERGING = "inferno", "PuOr_r"
BLUE, ORANGE, GREY = "#0072B2", "#D55E00", "#666666"
# of PNGs: a fifth larger than with 6, and written in a third of the time
COMPRESSION = 2


def save(figure: Figure, path: Path, dpi: int) -> None:
    """Write a figure as a PNG; laid out and drawn once, where savefig alone draws it twice."""
    figure.set_dpi(dpi)
    for text in figure.findobj(Text):
        text.set_text(printable(text.get_text()))
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    imsave(path, canvas.buffer_rgba(), dpi=dpi, pil_kwargs={"compress_level": COMPRESSION})


def seen_range(
    std: Float[np.ndarray, "..."], altitude: Float[np.ndarray, " pixels"]
) -> tuple[float, float]:
    """Bounds of a logarithmic scale for standard deviations: of what was seen.

    A cap that never rose has standard deviations that would hide the structure of the rest. What
    lies about its rim, a few percent, has the brightest colour, too.

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
    """At most ``n`` ticks on each axis, each with its whole number: no power beside the axis."""
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(MaxNLocator(n))
        axis.set_major_formatter(lambda value, _: number_of_tick(value))


def number_of_tick(value: float) -> str:
    """A number as short as its size allows: 12,500 and 1.5e10."""
    if value == 0 or 1e-3 <= abs(value) < 1e6:
        return f"{value:,.6g}"
    mantissa, power = f"{value:.3e}".split("e")
    return f"{float(mantissa):g}e{int(power)}"


def without_minor_ticks(axis: Axis) -> None:
    """Leave out the minor ticks of a logarithmic axis of many decades: hundreds, slow to draw."""
    axis.set_minor_locator(NullLocator())


def orthographic(axes: Axes, grid: HemisphereGrid, pattern: Complex[np.ndarray, "theta phi"]):
    """Draw ``|pattern|`` on the plane of the horizon: x East, y North."""
    power = np.abs(pattern)
    phi = np.append(grid.phi, 2 * np.pi)
    closed = np.concatenate([power, power[:, :1]], axis=1) / power.max()
    # the grid has no node at the zenith itself: every azimuth of the first ring meets there
    closed = np.concatenate([np.full((1, closed.shape[1]), closed[0].mean()), closed])
    theta = np.append(0.0, grid.theta)
    x, y = (np.outer(np.sin(theta), f(phi)) for f in (np.cos, np.sin))
    image = axes.pcolormesh(
        x, y, closed, cmap=SEQUENTIAL, vmin=0, vmax=1, shading="gouraud", rasterized=True
    )
    axes.set(aspect="equal", xticks=[], yticks=[], xlim=(-1.15, 1.15), ylim=(-1.15, 1.15))
    axes.add_artist(Circle((0, 0), 1.0, fill=False, color=GREY, lw=0.8))
    for name, (px, py) in {
        "N": (0, 1.08),
        "E": (1.08, 0),
        "S": (0, -1.08),
        "W": (-1.08, 0),
    }.items():
        axes.text(px, py, name, ha="center", va="center", fontsize=8)
    axes.set_frame_on(False)
    return image


def colour_bar(
    figure: Figure, image: ScalarMappable, axes: Axes | list[Axes], **options: object
) -> Colorbar:
    """A colour bar; on a logarithmic scale with plain numbers, more of them on a narrow one."""
    bar = figure.colorbar(image, ax=axes, **options)
    if isinstance(image.norm, LogNorm):
        narrow = image.norm.vmax < 20.0 * image.norm.vmin
        subs = (1.0, 1.5, 2.0, 3.0, 5.0, 7.0) if narrow else (1.0, 2.0, 5.0)
        bar.set_ticks(LogLocator(subs=subs), minor=False)
        bar.set_ticks([], minor=True)
        bar.long_axis.set_major_formatter(lambda value, _: f"{value:,.0f}")
    return bar


def note(title: str, text: str) -> Figure:
    """Make a figure that says why there is none."""
    figure = Figure(figsize=(8, 1.6), layout="constrained")
    figure.suptitle(title)
    figure.text(0.5, 0.35, text, ha="center")
    return figure
