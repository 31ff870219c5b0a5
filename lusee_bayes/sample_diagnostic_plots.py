"""Figures that tell whether chains can be trusted: ranks, energies, pairs, the analytic witness."""

from __future__ import annotations

import numpy as np
import xarray as xr
from jaxtyping import Float
from matplotlib.figure import Figure
from scipy.stats import binom, rankdata

from lusee_bayes.plots import BLUE, GREY, ORANGE
from lusee_bayes.sites import SKY

RANK_BINS = 20
# quantities in the figures, the first of a run's list
N_RANKS, N_PAIRS = 8, 5
# bins of exact chains lie in the band that often
BAND = 0.99


def ranks(quantities: dict[str, Float[np.ndarray, "chains draws"]]) -> Figure:
    """Histograms of each chain's ranks among the draws of all chains, with a band for chance."""
    chosen = list(quantities.items())[:N_RANKS]
    rows = (len(chosen) + 3) // 4
    figure = Figure(figsize=(12, 2.6 * rows + 0.5), layout="constrained")
    panels = np.ravel(figure.subplots(rows, min(4, len(chosen)), squeeze=False))
    for axes in panels[len(chosen) :]:
        axes.set_axis_off()
    for axes, (name, draws) in zip(panels, chosen, strict=False):
        chains, n = draws.shape
        order = rankdata(draws.ravel()).reshape(chains, n)
        edges = np.linspace(0, draws.size, RANK_BINS + 1)
        counts = np.stack([np.histogram(chain, edges)[0] for chain in order])
        low, high = binom.interval(BAND, n, 1.0 / RANK_BINS)
        axes.axhspan(low, high, color=GREY, alpha=0.2, lw=0)
        centres = (edges[1:] + edges[:-1]) / 2 / draws.size
        for chain in counts:
            axes.step(centres, chain, where="mid", lw=1)
        axes.set_title(name, fontsize=9)
        axes.set(xlim=(0, 1), ylim=(0, None))
    figure.supxlabel("rank among the draws of all chains")
    figure.supylabel("draws per bin")
    figure.suptitle(f"Ranks, one line for each chain; band: {BAND:.0%} of independent draws")
    return figure


def energy(statistics: xr.Dataset) -> Figure:
    """Energies of the draws about their mean, and their changes from draw to draw."""
    energies = statistics["energy"].values
    changes = np.diff(energies, axis=1)
    figure = Figure(figsize=(7, 4), layout="constrained")
    axes = figure.subplots()
    centred = (energies - energies.mean()).ravel()
    bins = np.histogram_bin_edges(np.concatenate([centred, changes.ravel()]), 60)
    for values, colour, label in (
        (centred, BLUE, "energies about their mean"),
        (changes.ravel(), ORANGE, "changes from draw to draw"),
    ):
        axes.hist(values, bins, color=colour, histtype="step", lw=1.5, density=True, label=label)
    bfmi = (changes**2).mean(axis=1) / energies.var(axis=1)
    axes.set(
        xlabel="energy",
        ylabel="density",
        title=f"BFMI {', '.join(f'{value:.2f}' for value in bfmi)} (below 0.3: chains are slow)",
    )
    axes.legend(frameon=False)
    return figure


def pairs(quantities: dict[str, Float[np.ndarray, "chains draws"]]) -> Figure:
    """Draws of the first quantities against each other, and their histograms."""
    chosen = list(quantities.items())[:N_PAIRS]
    n = len(chosen)
    figure = Figure(figsize=(2.2 * n + 0.8, 2.2 * n + 0.5), layout="constrained")
    grid = figure.subplots(n, n, squeeze=False, sharex="col")
    for row, (name, draws) in enumerate(chosen):
        for column, (other, others) in enumerate(chosen):
            axes = grid[row, column]
            if column > row:
                axes.set_axis_off()
                continue
            if column == row:
                axes.hist(draws.ravel(), 40, color=BLUE, histtype="step")
                axes.set_yticks([])
            else:
                axes.plot(
                    others.ravel(), draws.ravel(), ls="", marker=".", ms=1.5, alpha=0.3, color=BLUE
                )
                if column:
                    axes.set_yticklabels([])
            if row == n - 1:
                axes.set_xlabel(other, fontsize=8)
            if column == 0 and row:
                axes.set_ylabel(name, fontsize=8)
            axes.tick_params(labelsize=7)
    figure.suptitle("Pairs of quantities")
    return figure


def against_analytic(tree: xr.DataTree) -> Figure:
    """Means and standard deviations of the sky's draws against the analytic posterior."""
    skies, constants = tree["posterior"][SKY].values, tree["constant_data"]
    mean, std = constants["analytic_mean"].values, constants["analytic_std"].values
    flat = skies.reshape(-1, skies.shape[-1])
    figure = Figure(figsize=(11, 4), layout="constrained")
    left, right = figure.subplots(1, 2)
    dots = {"ls": "", "marker": ".", "ms": 3, "color": BLUE}
    left.plot((flat.mean(axis=0) - mean) / std, **dots)
    left.axhline(0.0, color=GREY, lw=0.8)
    left.set(xlabel="mode", ylabel="difference [standard deviations]", title="Means")
    right.plot(flat.std(axis=0, ddof=1) / std, **dots)
    right.axhline(1.0, color=GREY, lw=0.8)
    right.set(xlabel="mode", ylabel="draws / analytic", title="Standard deviations")
    figure.suptitle("Draws against the analytic posterior, mode by mode")
    return figure
