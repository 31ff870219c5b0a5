"""Figures: data, beams, maps and spectra. Each function returns a matplotlib Figure."""

from __future__ import annotations

import healpy
import numpy as np
from jaxtyping import Complex, Float
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colorbar import Colorbar
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from matplotlib.patheffects import withStroke
from matplotlib.ticker import LogLocator

from lusee_bayes.beams import HemisphereGrid, stokes_beam
from lusee_bayes.building import build_fields
from lusee_bayes.metrics import ell_cross
from lusee_bayes.results import MapResult
from lusee_bayes.scenario import Scenario
from lusee_bayes.visibilities import Visibilities

# safe for colour-blind readers: perceptually uniform, and a blue-orange pair (Okabe-Ito) for lines
SEQUENTIAL, DIVERGING = "inferno", "PuOr_r"
BLUE, ORANGE, GREY = "#0072B2", "#D55E00", "#666666"


def data_vector(data: Visibilities) -> Figure:
    """The data vector as the paper draws it: products side by side, time running within each."""
    figure = Figure(figsize=(11, 4), layout="constrained")
    axes = figure.subplots()
    n_times = data.layout.n_times
    axes.plot(data.grid().ravel(), color=BLUE, lw=0.7)
    for k in range(1, data.layout.n_products):
        axes.axvline(k * n_times, color=GREY, lw=0.4)
    axes.set_xticks((np.arange(data.layout.n_products) + 0.5) * n_times, data.labels, fontsize=8)
    axes.tick_params(axis="x", length=0)
    axes.set(
        xlabel="product (time runs within each)",
        ylabel="visibility [K]",
        xlim=(0, n_times * data.layout.n_products),
        title=f"Data vector at {data.frequency_mhz:g} MHz, {data.layout.size} samples"
        + (f", {data.n_missing} missing" if data.n_missing else ""),
    )
    return figure


def beams(scenario: Scenario) -> Figure:
    """An auto and two crosses from above: zenith in the centre, North up, horizon at the rim."""
    grid = HemisphereGrid.gauss_legendre(64, 180)
    fields = build_fields(scenario, grid)
    patterns = np.asarray(stokes_beam(fields))
    names = {0: "auto 00", 2: "|cross 02|", 1: "|cross 01|"}
    if scenario.beam.file is None:
        names = {0: "auto 00 (North)", 2: "|cross 02| (opposite)", 1: "|cross 01| (perpendicular)"}
    panels = [(name, patterns[0, k]) for k, name in names.items() if k < fields.n_antennas]
    figure = Figure(figsize=(11, 4), layout="constrained")
    grid_of_axes = np.atleast_1d(figure.subplots(1, len(panels)))
    for axes, (title, pattern) in zip(grid_of_axes, panels, strict=True):
        image = orthographic(axes, grid, pattern)
        axes.set_title(title)
    figure.colorbar(image, ax=figure.axes, label="beam / its peak", shrink=0.8)
    figure.suptitle(f"Beams at {scenario.frequency_mhz:g} MHz, zenith at the centre")
    return figure


def orthographic(axes: Axes, grid: HemisphereGrid, pattern: Complex[np.ndarray, "theta phi"]):
    """Draw |pattern| on the plane of the horizon: x East, y North."""
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


def mollweide(
    axes: Axes,
    pixels: Float[np.ndarray, " pixels"],
    *,
    norm: Normalize,
    cmap: str = SEQUENTIAL,
    highest_altitude: Float[np.ndarray, " pixels"] | None = None,
):
    """A Galactic HEALPix RING map on Mollweide axes: centre l = 0, longitude grows to the left.

    ``highest_altitude``: draws a dashed line round the region that never rose.
    """
    # a degree between nodes, shaded smoothly: no finer than the eye needs, four times faster
    lon = np.linspace(180.0, -180.0, 361)
    lat = np.linspace(-90.0, 90.0, 181)
    grid_lon, grid_lat = np.meshgrid(lon, lat)

    def at(values):
        return healpy.get_interp_val(values, grid_lon, grid_lat, lonlat=True)

    x, y = np.radians(-grid_lon), np.radians(grid_lat)
    # negative temperatures have no logarithm: they take the darkest colour
    colours = colormaps[cmap].with_extremes(bad=colormaps[cmap](0.0))
    image = axes.pcolormesh(
        x, y, at(pixels), cmap=colours, norm=norm, shading="gouraud", rasterized=True
    )
    if highest_altitude is not None and (highest_altitude < 0).any():
        rim = axes.contour(
            x,
            y,
            at(highest_altitude),
            [0.0],
            colors="black",
            linestyles="dashed",
            linewidths=1.2,
        )
        # seen on dark maps and on light ones
        rim.set_path_effects([withStroke(linewidth=2.4, foreground="white", alpha=0.7)])
    axes.set_xticks(np.radians([-120, -60, 0, 60, 120]), ["120°", "60°", "0°", "300°", "240°"])
    axes.set_yticks(np.radians([-60, -30, 0, 30, 60]))
    axes.tick_params(labelsize=7)
    axes.grid(alpha=0.25, lw=0.4)
    return image


def colour_bar(
    figure: Figure, image: ScalarMappable, axes: Axes | list[Axes], **options: object
) -> Colorbar:
    """A colour bar; on a logarithmic scale with plain numbers at 1, 2 and 5 times powers of ten."""
    bar = figure.colorbar(image, ax=axes, **options)
    if isinstance(image.norm, LogNorm):
        bar.set_ticks(LogLocator(subs=(1.0, 2.0, 5.0)), minor=False)
        bar.set_ticks([], minor=True)
        bar.long_axis.set_major_formatter(lambda value, _: f"{value:,.0f}")
    return bar


def maps(result: MapResult) -> Figure:
    """Truth, posterior mean, residual over the mean temperature, and standard deviation."""
    values = result.maps()
    sky = values.get("truth", values["mean"])
    positive = np.percentile(sky[sky > 0], [0.5, 99.8])
    level = values["mean"].mean()
    panels = [("posterior mean", values["mean"], LogNorm(*positive), SEQUENTIAL, "K")]
    if "truth" in values:
        percent = 100.0 * values["residual"] / level
        span = np.percentile(np.abs(percent), 99.0)
        panels = [
            ("truth", values["truth"], LogNorm(*positive), SEQUENTIAL, "K"),
            *panels,
            ("mean - truth", percent, Normalize(-span, span), DIVERGING, "% of the mean sky"),
        ]
    spread = 100.0 * values["std"] / level
    bounds = Normalize(*np.percentile(spread, [0.5, 99.5]))
    panels.append(("posterior standard deviation", spread, bounds, SEQUENTIAL, "% of the mean sky"))
    rows = (len(panels) + 1) // 2
    figure = Figure(figsize=(12, 3.6 * rows), layout="constrained")
    for position, (title, pixels, norm, cmap, unit) in enumerate(panels):
        axes = figure.add_subplot(rows, 2, position + 1, projection="mollweide")
        image = mollweide(
            axes, pixels, norm=norm, cmap=cmap, highest_altitude=result.highest_altitude
        )
        colour_bar(figure, image, axes, label=unit, shrink=0.85, extend="both")
        axes.set_title(title)
    figure.suptitle(
        f"{result.experiment.scenario.frequency_mhz:g} MHz, Galactic coordinates; "
        "dashed: never above the horizon"
    )
    return figure


def fidelity(result: MapResult) -> Figure:
    """rho_ell and SNR_ell where the truth is known, and how much of each ell the prior supplies."""
    spectra = result.spectra()
    known = "snr" in spectra
    figure = Figure(figsize=(12 if known else 5, 4), layout="constrained")
    axes = np.atleast_1d(figure.subplots(1, 3 if known else 1))
    ell = spectra["ell"][1:]
    axes[-1].plot(ell, spectra["prior_fraction"][1:], color=BLUE)
    axes[-1].axhline(0.5, color=GREY, lw=0.8, ls=":")
    axes[-1].set(ylabel="share of the variance from the prior", ylim=(0, 1.02))
    if known:
        axes[0].plot(ell, spectra["rho"][1:], color=BLUE)
        axes[0].axhline(0.0, color=GREY, lw=0.8)
        axes[0].set(ylabel=r"correlation with the truth $\rho_\ell$", ylim=(-0.25, 1.05))
        axes[1].semilogy(ell, spectra["snr"][1:], color=BLUE)
        axes[1].axhline(1.0, color=GREY, lw=0.8, ls=":")
        axes[1].set(ylabel=r"$\mathrm{SNR}_\ell$")
        cross = ell_cross(spectra["snr"])
        if cross is not None:
            axes[1].axvline(cross, color=ORANGE, lw=1, ls="--", label=f"first below 1: {cross}")
            axes[1].legend(frameon=False)
    for panel in axes:
        panel.set(xlabel=r"multipole $\ell$", xlim=(1, ell[-1]))
    figure.suptitle(f"Fidelity at {result.experiment.scenario.frequency_mhz:g} MHz")
    return figure


def spectra(result: MapResult) -> Figure:
    """C_ell of prior, posterior mean, truth and posterior variance."""
    columns = result.spectra()
    figure = Figure(figsize=(6, 4.5), layout="constrained")
    axes = figure.subplots()
    ell = columns["ell"]
    styles = {
        "cl_prior": ("prior", GREY, "-"),
        "cl_truth": ("truth", "black", ":"),
        "cl_mean": ("posterior mean", BLUE, "-"),
        "cl_posterior_variance": ("posterior variance", ORANGE, "--"),
    }
    for name, (label, colour, line) in styles.items():
        if name in columns:
            axes.semilogy(ell, columns[name], color=colour, ls=line, label=label)
    axes.set(xlabel=r"multipole $\ell$", ylabel=r"$C_\ell$ [K$^2$]", xlim=(0, ell[-1]))
    axes.legend(frameon=False)
    axes.set_title(f"Power at {result.experiment.scenario.frequency_mhz:g} MHz")
    return figure
