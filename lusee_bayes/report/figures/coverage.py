"""Figures of a validation on given skies: coverage against its level, and maps of the pulls."""

from __future__ import annotations

import numpy as np
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

from lusee_bayes.linear.levels import LEVELS
from lusee_bayes.report.figures.drawing import BLUE, DIVERGING, GREY, ORANGE, colour_bar
from lusee_bayes.report.figures.mollweide import mollweide
from lusee_bayes.results.sky_coverage import SkiesResult

# pulls beyond that have the darkest colours
WIDEST = 4.0
# shares further from their levels than that are drawn at the rim
FURTHEST = 50.0
# maps of pulls side by side
COLUMNS = 3


def coverage(result: SkiesResult) -> Figure:
    """Observed share less the level of the interval, by sky and band, with its scatter."""
    rows, levels = len(result.skies), 100.0 * np.array(LEVELS)
    n_bands = len(result.skies[0].pixels.names)
    figure = Figure(figsize=(11, 1.25 * rows + 1.6))
    places = {"left": 0.17, "right": 0.99, "wspace": 0.06, "hspace": 0.15}
    places |= {"bottom": 0.75 / (1.25 * rows + 1.6), "top": 1.0 - 0.7 / (1.25 * rows + 1.6)}
    panels = figure.subplots(
        rows, n_bands, sharex=True, sharey=True, squeeze=False, gridspec_kw=places
    )
    for line, sky in zip(panels, result.skies, strict=True):
        for axes, part in zip(line, sky.pixels.coverage(), strict=True):
            off = 100.0 * np.array(part.held) - levels
            scatter = 100.0 * np.array(part.scatter)
            for n, alpha in ((2.0, 0.2), (1.0, 0.25)):
                axes.fill_between(levels, -n * scatter, n * scatter, color=GREY, alpha=alpha, lw=0)
            axes.axhline(0.0, color=GREY, lw=0.6)
            inside = np.abs(off) <= 2.0 * scatter
            axes.plot(levels, np.clip(off, -FURTHEST, FURTHEST), color=BLUE, lw=0.8)
            for some, colour in ((inside, BLUE), (~inside, ORANGE)):
                axes.plot(
                    levels[some], np.clip(off[some], -FURTHEST, FURTHEST), "o", color=colour, ms=4
                )
            axes.text(
                0.03,
                0.05,
                f"rms {part.rms:.2f} ± {part.rms_scatter:.2f}, "
                f"largest {part.largest:.1f} ({part.allowed:.1f})",
                transform=axes.transAxes,
                fontsize=7,
            )
        verdict = "hold" if result.held(sky) else "do not hold"
        line[0].set_ylabel(
            f"{_short(sky.name)}\n({verdict})",
            rotation=0,
            ha="right",
            va="center",
            labelpad=2,
            fontsize=9,
        )
    for axes, name in zip(panels[0], result.skies[0].pixels.names, strict=True):
        axes.set_title(name, fontsize=10)
    panels[0, 0].set(ylim=(-FURTHEST - 3.0, FURTHEST + 3.0), xlim=(46.0, 99.0))
    panels[0, 0].set_xticks(levels, [f"{level:.0f}" for level in levels])
    figure.supxlabel("level of the interval [%]", fontsize=10)
    figure.suptitle(
        f"{result.scenario.frequency_mhz:g} MHz: share of pixels whose truth an interval holds, "
        "less its level [%]; grey: scatter and twice the scatter",
        fontsize=11,
    )
    return figure


def pulls(result: SkiesResult) -> Figure:
    """Maps of (truth - mean) / std, one for each sky."""
    n = len(result.skies)
    columns = min(COLUMNS, n)
    rows = -(-n // columns)
    figure = Figure(figsize=(4.6 * columns, 2.6 * rows + 1.2), layout="constrained")
    panels = figure.subplots(rows, columns, squeeze=False).ravel()
    for axes, sky in zip(panels, result.skies, strict=False):
        pull = sky.pull()
        image = mollweide(
            axes,
            pull,
            norm=Normalize(-WIDEST, WIDEST),
            cmap=DIVERGING,
            highest_altitude=sky.channel.highest_altitude,
        )
        axes.set_title(f"{_short(sky.name)}: {pull.min():.1f} to {pull.max():+.1f}", fontsize=10)
    for axes in panels[n:]:
        axes.set_axis_off()
    colour_bar(
        figure,
        image,
        list(panels),
        label="(truth - mean) / standard deviation",
        orientation="horizontal",
        shrink=0.5,
        aspect=40,
        extend="both",
    )
    return figure


def _short(name: str, longest: int = 18) -> str:
    return name if len(name) <= longest else f"{name[: longest - 3]}..."
