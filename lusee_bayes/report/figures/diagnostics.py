"""Figures of what diagnostics.nc holds: draws as maps, residuals by product and time."""

from __future__ import annotations

import numpy as np
import xarray as xr
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure

from lusee_bayes.linear.fit import probability
from lusee_bayes.report.figures.drawing import (
    BLUE,
    DIVERGING,
    GREY,
    ORANGE,
    colour_bar,
    without_minor_ticks,
)
from lusee_bayes.report.figures.mollweide import mollweide

# residuals beyond that have the darkest colours
WIDEST = 4.0
# p-values are shown down to that
LEAST_P = 1e-10


def draws(found: xr.Dataset) -> Figure:
    """Draws of the posterior as Galactic maps, on one scale."""
    maps = found["draws"].values
    positive = np.percentile(maps[maps > 0], [0.5, 99.8])
    altitude = found["highest_altitude"].values
    rows = (len(maps) + 1) // 2
    figure = Figure(figsize=(12, 3.6 * rows))
    places = {"left": 0.01, "right": 0.98, "bottom": 0.01, "top": 0.9, "wspace": 0.02}
    grid_of_axes = figure.subplots(rows, 2, gridspec_kw=places | {"hspace": 0.12}).ravel()
    for k, (axes, pixels) in enumerate(zip(grid_of_axes, maps, strict=True)):
        image = mollweide(axes, pixels, norm=LogNorm(*positive), highest_altitude=altitude)
        axes.set_title(f"draw {k + 1}")
    colour_bar(figure, image, figure.axes, label="K", shrink=0.7, extend="both", pad=0.02)
    figure.suptitle(f"Draws of the posterior at {found.attrs['frequency_mhz']:g} MHz")
    return figure


def residuals(found: xr.Dataset) -> Figure:
    """Every datum against the prediction of all others, and what each product's removal mends."""
    labels, hours, z = found["product"].values, found["hours"].values, found["z"].values
    figure = Figure(figsize=(12, 4.8))
    places = {"left": 0.06, "right": 0.98, "bottom": 0.11, "top": 0.82, "wspace": 0.03}
    left, right = figure.subplots(1, 2, width_ratios=(3, 1), sharey=True, gridspec_kw=places)
    # samples are not evenly spaced where runs follow one another or nights are left out
    image = left.pcolormesh(
        np.append(np.arange(len(hours)), len(hours)) - 0.5,
        np.arange(len(labels) + 1) - 0.5,
        z,
        cmap=DIVERGING,
        norm=Normalize(-WIDEST, WIDEST),
        rasterized=True,
    )
    ticks = np.linspace(0, len(hours) - 1, 7).astype(int)
    left.set_xticks(ticks, [f"{hours[k] / 24:.1f}" for k in ticks])
    left.set_yticks(np.arange(len(labels)), labels)
    left.invert_yaxis()
    left.set(xlabel="time [days]", ylabel="product", title="Each datum given all others")
    left.set_facecolor("0.8")
    figure.colorbar(
        image, ax=left, label="standard deviations", extend="both", shrink=0.9, pad=0.02
    )
    of_products = found["group_kind"].values == "product"
    names = found["group_name"].values[of_products]
    rows = [list(labels).index(name) for name in names]
    for key, marker, colour, text in (
        ("group_p", "o", BLUE, "product given all others"),
        ("group_others_p", "D", ORANGE, "all others without it"),
    ):
        p = np.maximum(found[key].values[of_products], LEAST_P)
        right.semilogx(p, rows, ls="", marker=marker, color=colour, ms=5, label=text)
    without_minor_ticks(right.xaxis)
    right.axvline(1.0, color=GREY, lw=0.5)
    right.set(xlabel=f"p-value (drawn down to {LEAST_P:g})", xlim=(LEAST_P / 3, 3))
    right.grid(axis="y", lw=0.3)
    right.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), frameon=False, fontsize=8)
    p = probability(found.attrs["instrument_p"])
    figure.suptitle(
        f"Residuals at {found.attrs['frequency_mhz']:g} MHz: p {p} of what no sky explains"
    )
    return figure
