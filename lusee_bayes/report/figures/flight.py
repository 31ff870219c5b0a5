"""Flight data: gain states and flags in time, products before and after, gains and noise."""

from __future__ import annotations

import astropy.units as u
import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from lusee_bayes.flight.gain_model import LETTERS
from lusee_bayes.flight.reduced import REASONS, USED, Reduced
from lusee_bayes.instrument.products import all_products, labels
from lusee_bayes.instrument.times import unannounced_leap_seconds
from lusee_bayes.report.figures.drawing import BLUE, GREY, ORANGE, plain_ticks

# Okabe and Ito's colours, which colour-blind readers tell apart
LEVEL_COLOURS = {"L": "#56B4E9", "M": "#0072B2", "H": "#CC79A7"}
PORT_COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7")
# columns of pixels of an image of flags
COLUMNS = 800


def time_line(reduced: Reduced) -> Figure:
    """Draw the gain of every port and what was flagged, over time."""
    days = _days(reduced)
    reasons = [k for k in range(1, len(REASONS)) if (reduced.reason == k).any()]
    lines = [name for name in ("lines",) if (reduced.lines > 0).any()]
    names = [REASONS[k] for k in reasons] + (["some channels"] if lines else [])
    figure = Figure(figsize=(12, 3.4 + 0.25 * len(names)), layout="constrained")
    top, bottom = figure.subplots(2, 1, sharex=True, height_ratios=(4, max(len(names), 1)))
    level = reduced.level[reduced.bin_of]
    n_ports = level.shape[1]
    for port in range(n_ports):
        for letter, colour in LEVEL_COLOURS.items():
            here = level[:, port] == letter
            if here.any():
                top.plot(days[here], np.full(here.sum(), port), "|", ms=9, color=colour)
    handles = [
        top.plot([], [], "s", color=colour, label=f"gain {letter}")[0]
        for letter, colour in LEVEL_COLOURS.items()
        if (level == letter).any()
    ]
    top.legend(handles=handles, loc="upper right", ncols=3, frameon=False)
    top.set(yticks=range(n_ports), ylabel="port", ylim=(n_ports - 0.5, -1.2))
    top.set_title("Gain of every port")
    marks = [(reduced.reason == k).any(axis=0) for k in reasons]
    if lines:
        marks.append(((reduced.lines > 0) & (reduced.reason == USED)).any(axis=0))
    for row, flagged in enumerate(marks):
        bottom.plot(days[flagged], np.full(flagged.sum(), row), "|", ms=9, color=ORANGE)
    bottom.set(
        yticks=range(len(names)),
        yticklabels=names,
        ylim=(max(len(names), 1) - 0.5, -0.5),
        xlabel=f"days since {_first(reduced)} UTC",
    )
    bottom.set_title("Flagged in at least one band" if names else "Nothing is flagged")
    return figure


def waterfall(reduced: Reduced, band: int) -> Figure:
    """Draw the 16 products of a band over time, before and after flags."""
    figure = Figure(figsize=(13, 9), layout="constrained")
    panels = figure.subplots(4, 4, sharex=True)
    first = np.searchsorted(reduced.bin_of, np.arange(reduced.values.shape[2]))
    days = _days(reduced)[first]
    n_bins = reduced.values.shape[2]
    used_in_part = np.bincount(reduced.bin_of, reduced.reason[band] != USED, n_bins) > 0
    products = {label: k for k, label in enumerate(labels())}
    for product in all_products():
        # imaginary parts below the diagonal
        i, j = (product.i, product.j) if product.part == "R" else (product.j, product.i)
        axes: Axes = panels[i, j]
        number = products[product.label]
        kept = reduced.values[band, number]
        flagged = ~np.isfinite(kept) | used_in_part
        axes.plot(days, kept, ".", ms=3, color=BLUE, label="after flags")
        before = reduced.before[band, number]
        axes.plot(
            days[flagged], before[flagged], ".", ms=4, color=ORANGE, label="before, where flagged"
        )
        low, high = _range(kept[np.isfinite(kept)])
        axes.set_ylim(low, high)
        axes.set_title(product.label, fontsize=9)
        plain_ticks(axes, 3)
        axes.yaxis.set_major_formatter(lambda value, _: f"{value:.3g}")
    panels[0, 0].legend(frameon=False, fontsize=8)
    for axes in panels[-1]:
        axes.set_xlabel("days")
    for axes in panels[:, 0]:
        axes.set_ylabel("V²/Hz")
    figure.suptitle(
        f"Products at {reduced.frequencies_mhz[band]:g} MHz since {_first(reduced)} UTC; values "
        "beyond the frame are flagged"
    )
    return figure


def calibration(reduced: Reduced) -> Figure:
    """Draw the gains with their errors, and the noise found over the noise expected.

    Of one band the gains at its frequency are points with error bars, and both kinds of scatter
    have a place of their own.
    """
    figure = Figure(figsize=(12, 4.2), layout="constrained")
    left, right = figure.subplots(1, 2)
    _gains(left, reduced)
    if len(reduced.frequencies_mhz) == 1:
        _scatter_of_one(right, reduced)
    else:
        _scatter(right, reduced)
    right.axhline(1.0, color=GREY, lw=0.8)
    right.set_ylabel("scatter over radiometer noise")
    found = np.concatenate([reduced.line_scatter, reduced.scatter, [1.0]])
    right.set_ylim(0.0, 1.3 * float(np.nanmax(found)))
    right.set_title("Noise found over noise expected")
    return figure


def _gains(left: Axes, reduced: Reduced) -> None:
    curves, alone = reduced.curves, len(reduced.frequencies_mhz) == 1
    for number, letter in enumerate(LETTERS):
        for port in range(curves.gain.shape[1]):
            gain, std = curves.gain[number, port], curves.std[number, port]
            if not np.isfinite(gain).any():
                continue
            label = f"{letter}{port}"
            (line,) = left.semilogy(
                curves.frequencies_mhz,
                gain,
                color=PORT_COLOURS[port],
                ls={"L": ":", "M": "-", "H": "--"}[letter],
                label=label,
            )
            low = np.maximum(gain - std, 1e-3 * gain)
            left.fill_between(
                curves.frequencies_mhz, low, gain + std, color=line.get_color(), alpha=0.25, lw=0
            )
            if alone:
                f = reduced.frequencies_mhz
                at, error = (np.interp(f, curves.frequencies_mhz, y) for y in (gain, std))
                left.errorbar(f, at, error, fmt="o", ms=4, capsize=3, color=line.get_color())
    for f in reduced.frequencies_mhz:
        left.axvline(f, color=GREY, lw=0.5, zorder=0)
    known = bool((curves.std > 0).any())
    left.set(xlabel="frequency [MHz]", ylabel="counts for 1 nV²/Hz")
    largest = float(np.nanmax(curves.std / curves.gain)) if known else 0.0
    told = f"known to {largest:.2g} of themselves or better" if known else "no error is known"
    left.set_title(f"Gains: {told}")
    left.legend(frameon=False, ncols=2, fontsize=8)


def _scatter(right: Axes, reduced: Reduced) -> None:
    for values, colour, mark, name in (
        (reduced.line_scatter, BLUE, "o", "channels about a smooth spectrum"),
        (reduced.scatter, ORANGE, "s", "spectra about a smooth curve in time"),
    ):
        if np.isfinite(values).any():
            right.plot(
                reduced.frequencies_mhz, values, mark, color=colour, label=name, fillstyle="none"
            )
    right.set_xlabel("frequency [MHz]")
    if right.get_legend_handles_labels()[0]:
        right.legend(frameon=False, fontsize=8)


def _scatter_of_one(right: Axes, reduced: Reduced) -> None:
    kinds = (
        (reduced.line_scatter, BLUE, "o", "channels about\na smooth spectrum"),
        (reduced.scatter, ORANGE, "s", "spectra about\na smooth curve in time"),
    )
    for place, (values, colour, mark, _) in enumerate(kinds):
        if np.isfinite(values[0]):
            right.plot([place], values, mark, ms=8, color=colour)
            right.annotate(
                f"{values[0]:.3f}", (place, values[0]), (12, 8), textcoords="offset points"
            )
        else:
            right.text(place, 0.5, "not known", ha="center", color=GREY)
    right.set_xticks(range(len(kinds)), [kind[-1] for kind in kinds])
    right.set_xlim(-0.6, len(kinds) - 0.4)


def _days(reduced: Reduced) -> Float[np.ndarray, " rows"]:
    times = reduced.observation.times
    with unannounced_leap_seconds():
        return np.asarray((times - times[0]).to_value(u.day))


def _first(reduced: Reduced) -> str:
    return str(reduced.observation.times[0].isot)[:16]


def _range(values: Float[np.ndarray, " kept"]) -> tuple[float, float]:
    """Bounds that show what is kept, with a tenth beyond."""
    if not values.size:
        return 0.0, 1.0
    low, high = float(values.min()), float(values.max())
    edge = 0.1 * (high - low) or max(abs(high), 1e-30)
    return low - edge, high + edge
