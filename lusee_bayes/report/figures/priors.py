"""The figure of one data set under several priors: evidence, coverage, errors."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from lusee_bayes.core.harmonics import power_spectrum
from lusee_bayes.linear.levels import LEVELS
from lusee_bayes.report.figures.comparison import COLOURS, LINES
from lusee_bayes.report.figures.drawing import GREY
from lusee_bayes.results.prior_comparison import PriorComparison

# of the interval whose coverage is drawn
LEVEL = 0.68
# differences up to that are on a linear scale
LINEAR = 3.0
# how each kind of data that is left out is drawn
MARKERS = {"product": "s", "day": "o"}


def priors(result: PriorComparison) -> Figure:
    """Draw differences of ln evidence and of ln p, coverage by latitude, and spectra of errors."""
    known = result.known_sky
    figure = Figure(figsize=(14 if known else 9.5, 4.4), layout="constrained")
    panels = figure.subplots(1, 3 if known else 2)
    _evidence(panels[0], result)
    if known:
        _coverage(panels[1], result)
    _errors(panels[-1], result)
    figure.suptitle(f"{result.scenario.frequency_mhz:g} MHz: one data set under several priors")
    return figure


def _evidence(axes: Axes, result: PriorComparison) -> None:
    """How far each prior is below the best of each measure."""
    rows = np.arange(len(result.priors))
    behind = np.array([result.best.log_evidence - one.log_evidence for one in result.priors])
    colours = [COLOURS[k % len(COLOURS)] for k in rows]
    axes.barh(rows, behind, color=colours, alpha=0.6, height=0.6, label="ln evidence (bars)")
    for j, held in enumerate(result.best.held_out):
        values = np.array([one.held_out[j].log_density for one in result.priors])
        label = f"ln p of {held.kind}s left out"
        axes.plot(
            values.max() - values, rows, f"k{MARKERS[held.kind]}", mfc="none", ms=7, label=label
        )
    axes.set_yticks(rows, [one.name for one in result.priors])
    axes.invert_yaxis()
    axes.set_xscale("symlog", linthresh=LINEAR, linscale=0.5)
    axes.set(xlabel="below the best", xlim=(-0.5, None))
    axes.legend(frameon=False, fontsize=8, loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=3)


def _coverage(axes: Axes, result: PriorComparison) -> None:
    n, k = len(result.priors), LEVELS.index(LEVEL)
    parts = [part.name for part in result.priors[0].channel.coverage]
    for j, one in enumerate(result.priors):
        x = np.arange(len(parts)) + 0.6 * ((j + 0.5) / n - 0.5)
        held = [100.0 * part.held[k] for part in one.channel.coverage]
        scatter = [100.0 * part.scatter[k] for part in one.channel.coverage]
        colour = COLOURS[j % len(COLOURS)]
        axes.errorbar(x, held, yerr=scatter, fmt="o", color=colour, capsize=3, label=one.name)
    axes.axhline(100.0 * LEVEL, color=GREY, lw=0.8)
    axes.set_xticks(np.arange(len(parts)), parts, fontsize=8)
    axes.set(ylabel=f"pixels that {LEVEL:.0%} intervals hold [%]", ylim=(None, 101.0))


def _errors(axes: Axes, result: PriorComparison) -> None:
    for j, one in enumerate(result.priors):
        channel = one.channel
        colour, line = COLOURS[j % len(COLOURS)], LINES[j % len(LINES)]
        expected = power_spectrum(channel.std)[1:]
        ell = np.arange(1, len(expected) + 1)
        if channel.truth is None:
            axes.semilogy(ell, expected, color=colour, ls=line, lw=1.3, label=one.name)
            continue
        axes.semilogy(ell, expected, color=colour, ls=":", lw=1.0)
        error = power_spectrum(channel.mean - channel.truth)[1:]
        axes.semilogy(ell, error, color=colour, ls="-", lw=1.3, label=one.name)
    if result.known_sky:
        truth = power_spectrum(result.best.channel.truth)[1:]
        axes.semilogy(ell, truth, color=GREY, lw=1.0, label="true sky")
        axes.set_title("errors (dotted: what error bars expect)", fontsize=9)
    else:
        axes.set_title("expected errors", fontsize=9)
    axes.set(xlabel=r"multipole $\ell$", ylabel=r"$C_\ell$ [K$^2$]")
    axes.legend(frameon=False, fontsize=8)
