"""Figures that test data: residuals, pointing, unknowns, and sessions with flags."""

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from lusee_bayes.core.checks import with_error
from lusee_bayes.flight.gain_model import LETTERS
from lusee_bayes.flight.reduced import REASONS, USED, Reduced
from lusee_bayes.instrument.products import all_products
from lusee_bayes.instrument.times import seconds_from
from lusee_bayes.judge.chi2 import probability
from lusee_bayes.report.figures import drawing
from lusee_bayes.results.map_result import MapResult

# residuals beyond this, or beyond 98 % of them, have the darkest colours
WIDEST = 4.0
# smaller p-values are drawn at this value
LEAST_P = 1e-10


def residuals_by_product(result: MapResult) -> Figure | None:
    """Residuals of every datum given all others, and p of each product and of the rest."""
    channel = result.channel
    if not result.single:
        return None
    z, hours, labels = channel.judged.z, channel.hours, channel.labels
    figure = Figure(figsize=(12, 4.8))
    places = {"left": 0.06, "right": 0.98, "bottom": 0.11, "top": 0.82, "wspace": 0.03}
    left, right = figure.subplots(1, 2, width_ratios=(3, 1), sharey=True, gridspec_kw=places)
    # samples need not be evenly spaced, e.g. between runs or without nights
    x, y = np.arange(len(hours) + 1) - 0.5, np.arange(len(labels) + 1) - 0.5
    widest = max(WIDEST, float(np.percentile(np.append(np.abs(z[np.isfinite(z)]), 0.0), 98)))
    style = {"cmap": drawing.DIVERGING, "norm": Normalize(-widest, widest), "rasterized": True}
    image, days = left.pcolormesh(x, y, z, **style), np.asarray(hours) / 24.0
    ticks = MaxNLocator(7).tick_values(days[0], days[-1])
    ticks = ticks[(ticks >= days[0]) & (ticks <= days[-1])]
    left.set_xticks(np.searchsorted(days, ticks), [f"{day:g}" for day in ticks])
    left.set_yticks(np.arange(len(labels)), labels)
    left.invert_yaxis()
    left.set(xlabel="time [days]", ylabel="product", title="Residuals given all other data")
    left.set_facecolor("0.8")
    bar = {"label": "standard deviations", "extend": "both", "shrink": 0.9, "pad": 0.02}
    figure.colorbar(image, ax=left, **bar)
    products = channel.judged.of_kind("product")
    rows = [labels.index(group.name) for group in products]
    for key, marker, colour, text in (
        ("p", "o", drawing.BLUE, "product given all others"),
        ("others_p", "D", drawing.ORANGE, "all others without it"),
    ):
        p = np.maximum([getattr(group, key) for group in products], LEAST_P)
        right.semilogx(p, rows, ls="", marker=marker, color=colour, ms=5, label=text)
    right.xaxis.minorticks_off()
    right.axvline(1.0, color=drawing.GREY, lw=0.5)
    right.set(xlabel=f"p-value (clipped at {LEAST_P:g})", xlim=(LEAST_P / 3, 3))
    right.grid(axis="y", lw=0.3)
    right.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), frameon=False, fontsize=8)
    p = probability(channel.instrument.p)
    figure.suptitle(f"Residuals at {channel.frequency_mhz:g} MHz (instrument + noise: p {p})")
    return figure


def groups_by_frequency(result: MapResult) -> Figure | None:
    """p-values of products, days and angles, for every channel whose groups were tested."""
    judged = [channel for channel in result.channels if channel.judged is not None]
    if result.single or not judged:
        return None
    p_values = [{str(group): group.p for group in channel.judged.groups} for channel in judged]
    names = list(dict.fromkeys(name for one in p_values for name in one))
    p = np.array([[one.get(name, np.nan) for one in p_values] for name in names])
    figure, axes = drawing.framed((max(5.0, 2.5 + 0.3 * len(judged)), 1.0 + 0.2 * len(names)))
    scale = Normalize(np.log10(LEAST_P), 0.0)
    image = axes.imshow(np.log10(np.maximum(p, LEAST_P)), cmap="magma", norm=scale, aspect="auto")
    shown = np.arange(0, len(judged), 1 + len(judged) // 20)
    axes.set_xticks(shown, [f"{judged[k].frequency_mhz:g}" for k in shown])
    axes.set_yticks(range(len(names)), names, fontsize=7)
    axes.set(xlabel="frequency [MHz]", title="Groups of data, each given all others")
    figure.colorbar(image, ax=axes, label="log10 p")
    return figure


# days whose errors exceed this multiple of the median are not shown: they would hide the others
TOO_WIDE = 20.0
# units by the ending of an unknown's name
UNITS = {"s": "s", "day": "s/day", "deg": "degrees", "m": "m", "k": "K"}


def in_words(name: str, unit: str = "") -> str:
    """Name of an unknown, with its unit, for figures."""
    kind, _, ending = name.rpartition("_")
    kind, unit = (kind, UNITS[ending]) if ending in UNITS else (name, unit)
    return kind.replace("_", " ") + (f" [{unit}]" if unit else "")


def pointing_by_day(result: MapResult) -> Figure | None:
    """Draw the preferred value of every offset for each day, and for all days together."""
    if not result.single or result.channel.pointing is None:
        return None
    offsets = result.channel.pointing.preferred.groupby("offset", sort=False)
    size = (12, 0.6 + 2.1 * len(offsets))
    figure, panels = drawing.framed(size, len(offsets), sharex=True, squeeze=False)
    for axes, (name, mine) in zip(panels[:, 0], offsets, strict=True):
        days, whole = mine[mine["first_day"] >= 0].dropna(), mine[mine["first_day"] < 0].dropna()
        most = TOO_WIDE * days["std"].median()
        days, whole = (rows[rows["std"] < most] for rows in (days, whole))
        middle = (days["first_day"] + days["last_day"] + 1) / 2.0
        axes.axhline(0.0, color=drawing.GREY, lw=0.8)
        style = {"fmt": "o", "ms": 3, "color": drawing.BLUE, "label": "each day"}
        axes.errorbar(middle, days["value"], days["std"], **style)
        for value, std in whole[["value", "std"]].to_numpy():
            axes.axhspan(value - std, value + std, color=drawing.ORANGE, alpha=0.3)
            axes.axhline(value, color=drawing.ORANGE)
        axes.set_ylabel(in_words(name))
    panels[0, 0].plot([], [], color=drawing.ORANGE, label="all days together")
    panels[0, 0].legend(loc="upper right", ncols=2, frameon=False)
    panels[-1, 0].set_xlabel("days since the first sample")
    figure.suptitle("Clock and pointing offsets preferred by the data, relative to the model")
    return figure


PANELS_IN_A_ROW = 4
# a prior that varies by more than the first factor with frequency, or is wider than the errors by
# more than the second, would hide them
WIDE, BROAD = 3.0, 30.0


def unknowns_by_frequency(result: MapResult) -> Figure | None:
    """Draw every unknown of all channels with its error, its prior and, if known, the truth."""
    table = result.table("unknowns", "table")
    if result.single or table is None:
        return None
    unknowns = table.groupby("unknown", sort=False)
    n_rows = -(-len(unknowns) // PANELS_IN_A_ROW)
    size = (13, 0.6 + 2.5 * n_rows)
    figure, panels = drawing.framed(size, n_rows, PANELS_IN_A_ROW, squeeze=False)
    for axes, (name, rows) in zip(panels.flat, unknowns, strict=False):
        columns = ("frequency_mhz", "value", "std", "prior", "prior_std")
        f, value, std, prior, before = (rows[column].to_numpy() for column in columns)
        axes.fill_between(f, prior - before, prior + before, color=drawing.GREY, alpha=0.25, lw=0)
        style = {"color": drawing.GREY, "fmt": "none", "lw": 4, "alpha": 0.4, "label": "prior"}
        axes.errorbar(f, prior, before, **style)
        axes.errorbar(f, value, std, color=drawing.BLUE, fmt=".", ms=5, lw=1.2, label="posterior")
        if "true" in rows:
            axes.plot(f, rows["true"].to_numpy(), "x", color=drawing.ORANGE, ms=5, label="truth")
        drawing.plain_ticks(axes, 5)
        axes.set(title=in_words(name, rows["unit"].iloc[0]), xlabel="frequency [MHz]")
        if prior.min() > 0.0 and prior.max() > WIDE * prior.min():
            axes.set_yscale("log")
        elif before.min() > BROAD * std.max() > 0.0:
            true = rows["true"].to_numpy() if "true" in rows else value
            low, high = np.minimum(value - 2 * std, true), np.maximum(value + 2 * std, true)
            room = max(std.max(), 0.05 * np.ptp(true))
            axes.set_ylim(low.min() - room, high.max() + room)
    for axes in panels.flat[len(unknowns) :]:
        axes.set_axis_off()
    handles, labels = panels[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper right", ncols=3, frameon=False)
    return figure


# half the width of a corner plot's panels, in posterior standard deviations
CORNER = 3.5, 8.0


def corner(result: MapResult) -> Figure | None:
    """Draw the posterior of a channel's unknowns, pair by pair, with prior and truth.

    The channel is the first one that agrees on the shared instrument. Axes are in posterior
    standard deviations from the posterior mean. They extend to the truth, up to 8; a truth beyond
    that is marked at the edge.
    """
    apart = [test.frequency_mhz for test in result.shared_tests if test.disagrees]
    of_all = (one for one in result.channels if one.frequency_mhz not in apart)
    channel = next(of_all, result.channel)
    theta = channel.theta
    if theta is None or theta.corner.empty:
        return None
    table, n = theta.corner, len(theta.corner)
    prior = ((table["prior"] - table["value"]) / table["std"]).to_numpy()
    wide = (table["prior_std"] / table["std"]).to_numpy()
    true, half = np.full(n, np.nan), CORNER[0]
    if "true" in table:
        true = ((table["true"] - table["value"]) / table["std"]).to_numpy()
        half = min(max(half, 1.2 * float(np.abs(true).max())), CORNER[1])
        true = np.clip(true, -0.97 * half, 0.97 * half)
    side, x, t = 1.3 * n + 1.0, np.linspace(-half, half, 201), np.linspace(0.0, 2 * np.pi, 101)
    ticks = [-2, 0, 2] if half < 5 else [-5, 0, 5]
    figure, panels = drawing.framed((side, 1.2 * side), n, n, squeeze=False)
    for (i, j), axes in np.ndenumerate(panels):
        axes.set(xlim=(-half, half), xticks=ticks, yticks=[])
        axes.tick_params(labelsize=7, labelbottom=i == n - 1)
        if j > i:
            axes.set_axis_off()
        elif i == j:
            before = np.exp(-0.5 * ((x - prior[i]) / wide[i]) ** 2)
            axes.plot(x, before, color=drawing.GREY, alpha=0.5, label="prior")
            axes.plot(x, np.exp(-0.5 * x**2), color=drawing.BLUE, label="posterior")
            axes.axvline(true[i], color=drawing.ORANGE, lw=1, label="truth")
            name, unit, value, std = table.iloc[i][["unknown", "unit", "value", "std"]]
            numbers = with_error(value, std).replace(" +-", "\n±")
            axes.set_title(f"{in_words(name, unit)}\n{numbers}", fontsize=7)
        else:
            axes.set(ylim=(-half, half), yticks=ticks if j == 0 else [])
            r = theta.correlation[i, j]
            across, up = np.cos(t), r * np.cos(t) + np.sqrt(max(1.0 - r**2, 0.0)) * np.sin(t)
            for k in (1, 2):
                pair = prior[j] + k * wide[j] * np.cos(t), prior[i] + k * wide[i] * np.sin(t)
                axes.plot(*pair, color=drawing.GREY, alpha=0.5, lw=1.2 / k)
                axes.plot(k * across, k * up, color=drawing.BLUE, lw=1.2 / k)
            axes.plot(true[j], true[i], "x", color=drawing.ORANGE, ms=6)
    handles, labels = panels[0, 0].get_legend_handles_labels()
    place = {"loc": "outside lower center", "ncols": min(n, 3), "fontsize": 8, "frameon": False}
    known = 2 + ("true" in table)
    figure.legend(handles[:known], labels[:known], **place)
    suffix = "" if result.single else f" (channel of {channel.frequency_mhz:g} MHz)"
    scale = "in posterior standard deviations from the mean"
    figure.suptitle(f"Unknowns of the instrument{suffix}\n{scale}", fontsize=9)
    return figure


LEVEL_COLOURS = {"L": drawing.COLOURS[4], "M": drawing.BLUE, "H": drawing.COLOURS[3]}


def time_line(reduced: Reduced) -> Figure:
    """Draw the gain of every port, and flags, over time."""
    days = _days(reduced)
    flags = {name: (reduced.reason == k).any(axis=0) for k, name in enumerate(REASONS) if k}
    flags = {name: flagged for name, flagged in flags.items() if flagged.any()}
    if (reduced.lines > 0).any():
        flags["some channels"] = ((reduced.lines > 0) & (reduced.reason == USED)).any(axis=0)
    n_rows = max(len(flags), 1)
    size, heights = (12, 3.4 + 0.25 * len(flags)), (4, n_rows)
    figure, (top, bottom) = drawing.framed(size, 2, sharex=True, height_ratios=heights)
    level, handles = reduced.level[reduced.bin_of], []
    n_ports = level.shape[1]
    for letter, colour in LEVEL_COLOURS.items():
        rows, ports = np.nonzero(level == letter)
        if len(rows):
            top.plot(days[rows], ports, "|", ms=9, color=colour)
            handles += top.plot([], [], "s", color=colour, label=f"gain {letter}")
    top.legend(handles=handles, loc="upper right", ncols=3, frameon=False)
    top.set(yticks=range(n_ports), ylabel="port", ylim=(n_ports - 0.5, -1.2))
    top.set_title("Gain of every port")
    for row, flagged in enumerate(flags.values()):
        bottom.plot(days[flagged], np.full(flagged.sum(), row), "|", ms=9, color=drawing.ORANGE)
    bottom.set(yticks=range(len(flags)), yticklabels=list(flags), ylim=(n_rows - 0.5, -0.5))
    bottom.set_xlabel(f"days since {_first(reduced)} UTC")
    bottom.set_title("Flagged in at least one band" if flags else "Nothing flagged")
    return figure


def waterfall(result: MapResult) -> Figure | None:
    """Draw the 16 products of the map's band over time, before and after flags."""
    reduced = result.reduced
    if not result.single or reduced is None:
        return None
    band = reduced.band(result.channel.frequency_mhz)
    figure, panels = drawing.framed((13, 9), 4, 4, sharex=True)
    days = _days(reduced)[np.searchsorted(reduced.bin_of, np.arange(reduced.values.shape[2]))]
    n_bins = reduced.values.shape[2]
    used_in_part = np.bincount(reduced.bin_of, reduced.reason[band] != USED, n_bins) > 0
    for number, product in enumerate(all_products()):
        # imaginary parts below the diagonal
        i, j = (product.i, product.j) if product.part == "R" else (product.j, product.i)
        axes: Axes = panels[i, j]
        kept = reduced.values[band, number]
        flagged = ~np.isfinite(kept) | used_in_part
        axes.margins(y=0.1)
        axes.plot(days, kept, ".", ms=3, color=drawing.BLUE, label="after flags")
        limits = axes.get_ylim()
        style = {"ms": 4, "color": drawing.ORANGE, "label": "before flags, where flagged"}
        axes.plot(days[flagged], reduced.before[band, number][flagged], ".", **style)
        axes.set_ylim(limits)
        axes.set_title(product.label, fontsize=9)
        drawing.plain_ticks(axes, 3)
        axes.yaxis.set_major_formatter(lambda value, _: f"{value:.3g}")
    panels[0, 0].legend(frameon=False, fontsize=8)
    for axes in panels[-1]:
        axes.set_xlabel("days")
    for axes in panels[:, 0]:
        axes.set_ylabel("V²/Hz")
    figure.suptitle(
        f"Products at {reduced.frequencies_mhz[band]:g} MHz since {_first(reduced)} UTC (values "
        "outside the frame are flagged)"
    )
    return figure


def calibration(reduced: Reduced) -> Figure:
    """Draw the gains with their errors, and the ratio of measured to expected noise.

    For one band, points with error bars mark the gains at its frequency.
    """
    figure, (left, right) = drawing.framed((12, 4.2), 1, 2)
    _gains(left, reduced)
    right.axhline(1.0, color=drawing.GREY, lw=0.8)
    for values, colour, mark, name in (
        (reduced.line_scatter, drawing.BLUE, "o", "channels about a smooth spectrum"),
        (reduced.scatter, drawing.ORANGE, "s", "spectra about a smooth curve in time"),
    ):
        label = name if np.isfinite(values).any() else f"{name}: unknown"
        style = {"color": colour, "label": label, "fillstyle": "none"}
        right.plot(reduced.frequencies_mhz, values, mark, **style)
    ratios = np.concatenate([reduced.line_scatter, reduced.scatter, [1.0]])
    right.set(ylim=(0.0, 1.3 * float(np.nanmax(ratios))), ylabel="scatter / radiometer noise")
    right.set(xlabel="frequency [MHz]", title="Measured / expected noise")
    right.legend(frameon=False, fontsize=8)
    return figure


def _gains(left: Axes, reduced: Reduced) -> None:
    curves, alone = reduced.curves, len(reduced.frequencies_mhz) == 1
    for number, letter in enumerate(LETTERS):
        for port in range(curves.gain.shape[1]):
            gain, std = curves.gain[number, port], curves.std[number, port]
            if not np.isfinite(gain).any():
                continue
            colour, line = drawing.COLOURS[port], {"L": ":", "M": "-", "H": "--"}[letter]
            mhz, low = curves.frequencies_mhz, np.maximum(gain - std, 1e-3 * gain)
            left.semilogy(mhz, gain, color=colour, ls=line, label=f"{letter}{port}")
            left.fill_between(mhz, low, gain + std, color=colour, alpha=0.25, lw=0)
            if alone:
                f = reduced.frequencies_mhz
                value, error = (np.interp(f, mhz, y) for y in (gain, std))
                left.errorbar(f, value, error, fmt="o", ms=4, capsize=3, color=colour)
    for f in reduced.frequencies_mhz:
        left.axvline(f, color=drawing.GREY, lw=0.5, zorder=0)
    largest = float(np.nanmax(curves.std / curves.gain))
    words = f"{100 * largest:.2g} % or better" if largest > 0.0 else "unknown"
    left.set(xlabel="frequency [MHz]", ylabel="counts for 1 nV²/Hz", title=f"Gain errors: {words}")
    left.legend(frameon=False, ncols=2, fontsize=8)


def _days(reduced: Reduced) -> Float[np.ndarray, " rows"]:
    times = reduced.observation.times
    return seconds_from(times[0], times) / 86400.0


def _first(reduced: Reduced) -> str:
    return str(reduced.observation.times[0].isot)[:16]
