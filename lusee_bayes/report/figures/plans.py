"""Figures that compare forecasts, and one data set under several priors."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from lusee_bayes.core.harmonics import power_spectrum
from lusee_bayes.judge.coverage import LEVELS
from lusee_bayes.report.figures.drawing import COLOURS, GREY, LINES, framed
from lusee_bayes.results.forecast import AS_GIVEN, Forecast
from lusee_bayes.results.prior_comparison import PriorComparison

# distinct without colour vision and by shape; repeated after four
STYLES = tuple(zip(COLOURS, "os^D", strict=False))
# row of every family and name of a variation
Rows = dict[tuple[str, str], float]
# numbers of a forecast with their axis labels; None means that the threshold is not reached
PANELS = {
    "information_bits": "information about the sky [bits]",
    "modes": "modes with expected SNR > 1 [number]",
    "ell_cross": r"first $\ell$ with expected SNR$_\ell$ < 1",
}


def forecasts(planned: Sequence[Forecast]) -> Figure:
    """Information, modes with SNR > 1 and ell_cross of every variation, grouped by family.

    Dashed: each scenario as given. An open marker beyond lmax: SNR > 1 at every ell.
    """
    rows = _row_positions(planned)
    sources = list(dict.fromkeys(f.variation.source for f in planned))
    size = (11.5, 1.6 + 0.23 * (max(rows.values()) + 1))
    figure, axes = framed(size, 1, len(PANELS), sharey=True)
    for number, source in enumerate(sources):
        mine = [f for f in planned if f.variation.source == source]
        # side by side, so that equal values do not overlap
        lower = 0.2 * (number - (len(sources) - 1) / 2)
        places = {row: y + lower for row, y in rows.items()}
        for name, axis in zip(PANELS, axes, strict=True):
            _marks(axis, name, mine, places, STYLES[number % len(STYLES)], len(sources) == 1)
    for label, axis in zip(PANELS.values(), axes, strict=True):
        axis.set_xlabel(label)
        axis.xaxis.set_major_locator(MaxNLocator(6, integer=True))
        axis.grid(axis="x", alpha=0.3, lw=0.5)
        for (_, name), y in rows.items():
            if name:
                axis.axhline(y, color=GREY, alpha=0.25, lw=0.5, zorder=0)
        axis.margins(x=0.14)
        axis.tick_params(axis="y", length=0)
        axis.spines[["top", "right", "left"]].set_visible(False)
    labels = [name or family for family, name in rows]
    axes[0].set_yticks(list(rows.values()), labels, fontsize=9)
    axes[0].set_ylim(max(rows.values()) + 0.7, -0.7)  # from the top down
    for (_, name), tick in zip(rows, axes[0].get_yticklabels(), strict=True):
        if not name:
            tick.set(fontweight="bold", color=GREY)
    if len(sources) > 1:
        handles = axes[0].get_legend_handles_labels()
        figure.legend(*handles, loc="outside lower center", ncols=4, frameon=False)
    figure.suptitle(_title(planned, sources))
    return figure


def _row_positions(planned: Sequence[Forecast]) -> Rows:
    """The row of every (family, variation), and of each family's title, (family, "")."""
    rows: Rows = {}
    for family in dict.fromkeys(f.variation.family for f in planned):
        names = dict.fromkeys(f.variation.name for f in planned if f.variation.family == family)
        if family != AS_GIVEN:
            rows[family, ""] = float(len(rows))
        for name in names:
            rows[family, name] = float(len(rows))
    return rows


def _marks(
    axes: Axes, name: str, mine: Sequence[Forecast], rows: Rows, style: tuple[str, str], texts: bool
) -> None:
    """Draw the markers of one scenario in one panel; ``texts`` adds their values."""
    colour, marker = style
    for forecast in mine:
        value = getattr(forecast, name)
        # without a crossing, one ell beyond the last
        x = len(forecast.snr_squared) if value is None else value
        y = rows[forecast.variation.family, forecast.variation.name]
        face = "white" if value is None else colour
        label = forecast.variation.source if forecast is mine[0] else None
        axes.plot(x, y, marker, color=colour, mfc=face, ms=6, label=label)
        if texts:
            text = f"> {x - 1}" if value is None else f"{value:.0f}"
            box = {"fc": "white", "ec": "none", "pad": 0.8}
            style = {"textcoords": "offset points", "va": "center", "fontsize": 8, "bbox": box}
            axes.annotate(text, (x, y), (7, 0), **style)
    reference = getattr(mine[0], name)
    if reference is not None:
        axes.axvline(reference, color=colour, lw=0.9, ls="--", zorder=0)


def _title(planned: Sequence[Forecast], sources: Sequence[str]) -> str:
    """The scenarios, with frequency and lmax if these are the same for all."""
    scenarios = [f.variation.scenario for f in planned]
    scope = ", ".join(sources) if len(sources) == 1 else f"{len(sources)} scenarios"
    if len({s.frequency_mhz for s in scenarios}) == 1:
        scope += f" at {scenarios[0].frequency_mhz:g} MHz"
    if len({s.lmax for s in scenarios}) == 1:
        scope += rf", up to $\ell$ = {scenarios[0].lmax}"
    return f"Information content: {scope} (dashed: scenario as given)"


# level of the interval whose coverage is drawn
LEVEL = 0.68
# the scale of differences is linear up to this value
LINEAR = 3.0
# marker of each kind of held-out data
MARKERS = {"product": "s", "day": "o"}


def priors(result: PriorComparison) -> Figure:
    """Draw differences of ln evidence and of ln p, coverage by latitude, and spectra of errors."""
    with_truth = result.known_sky
    figure, panels = framed((14 if with_truth else 9.5, 4.4), 1, 3 if with_truth else 2)
    _evidence(panels[0], result)
    if with_truth:
        _coverage(panels[1], result)
    _errors(panels[-1], result)
    figure.suptitle(f"{result.scenario.frequency_mhz:g} MHz: one data set under several priors")
    return figure


def _evidence(axes: Axes, result: PriorComparison) -> None:
    """Draw how far each prior is below the best, for each measure."""
    rows = np.arange(len(result.priors))
    behind = np.array([result.best.log_evidence - one.log_evidence for one in result.priors])
    colours = [COLOURS[k % len(COLOURS)] for k in rows]
    axes.barh(rows, behind, color=colours, alpha=0.6, height=0.6, label="ln evidence (bars)")
    for j, held in enumerate(result.best.held_out):
        values = np.array([one.held_out[j].log_density for one in result.priors])
        style = {"mfc": "none", "ms": 7, "label": f"ln p of held-out {held.kind}s"}
        axes.plot(values.max() - values, rows, f"k{MARKERS[held.kind]}", **style)
    axes.set_yticks(rows, [one.name for one in result.priors])
    axes.invert_yaxis()
    axes.set_xscale("symlog", linthresh=LINEAR, linscale=0.5)
    axes.set(xlabel="difference from the best", xlim=(-0.5, None))
    axes.legend(frameon=False, fontsize=8, loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=3)


def _coverage(axes: Axes, result: PriorComparison) -> None:
    n, k = len(result.priors), LEVELS.index(LEVEL)
    parts = [part.name for part in result.priors[0].coverage]
    for j, one in enumerate(result.priors):
        x = np.arange(len(parts)) + 0.6 * ((j + 0.5) / n - 0.5)
        held = [100.0 * part.held[k] for part in one.coverage]
        scatter = [100.0 * part.scatter[k] for part in one.coverage]
        colour = COLOURS[j % len(COLOURS)]
        axes.errorbar(x, held, yerr=scatter, fmt="o", color=colour, capsize=3, label=one.name)
    axes.axhline(100.0 * LEVEL, color=GREY, lw=0.8)
    axes.set_xticks(np.arange(len(parts)), parts, fontsize=8)
    axes.set(ylabel=f"pixels covered by {LEVEL:.0%} intervals [%]", ylim=(None, 101.0))


def _errors(axes: Axes, result: PriorComparison) -> None:
    for j, (one, channel) in enumerate(zip(result.priors, result.channels, strict=True)):
        colour, line = COLOURS[j % len(COLOURS)], LINES[j % len(LINES)]
        error = power_spectrum(channel.std)[1:]
        ell = np.arange(1, len(error) + 1)
        if channel.truth is not None:
            axes.semilogy(ell, error, color=colour, ls=":", lw=1.0)
            error, line = power_spectrum(channel.mean - channel.truth)[1:], "-"
        axes.semilogy(ell, error, color=colour, ls=line, lw=1.3, label=one.name)
    if result.known_sky:
        truth = power_spectrum(result.channels[0].truth)[1:]
        axes.semilogy(ell, truth, color=GREY, lw=1.0, label="true sky")
        axes.set_title("errors (dotted: expected from the error bars)", fontsize=9)
    else:
        axes.set_title("expected errors", fontsize=9)
    axes.set(xlabel=r"multipole $\ell$", ylabel=r"$C_\ell$ [K$^2$]")
    axes.legend(frameon=False, fontsize=8)
