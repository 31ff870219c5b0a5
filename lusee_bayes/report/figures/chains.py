"""Figures that show whether chains can be trusted: ArviZ's, and the analytic posterior."""

from __future__ import annotations

from collections.abc import Iterable

import arviz_base
import arviz_plots
import numpy as np
import xarray as xr
from jaxtyping import Float
from matplotlib import pyplot
from matplotlib.figure import Figure

from lusee_bayes.report.figures.drawing import BLUE, GREY, note, plain_ticks
from lusee_bayes.systematics.base import SKY

# quantities in the figures, the first of a run's list
N_RANKS, N_PAIRS = 8, 5
# draws of a chain from which ranks and densities can be estimated
FEWEST = 4
TOO_FEW = f"not drawn: a chain has fewer than {FEWEST} draws, or has not moved"
SIZE = {"layout": "constrained"}

Quantities = dict[str, Float[np.ndarray, "chains draws"]]


def ranks(quantities: Quantities) -> Figure:
    """Ranks of each chain's draws among all: differences of their ECDFs from even ones.

    The grey band holds 99 % of the curves of chains that agree.
    """
    title = "Ranks among the draws of all chains, one curve for each chain"
    chosen = dict(list(quantities.items())[:N_RANKS])
    if not _vary(chosen.values()):
        return note(title, TOO_FEW)
    rows = (len(chosen) + 3) // 4
    collection = arviz_plots.plot_rank(
        arviz_base.from_dict({"posterior": chosen}),
        backend="matplotlib",
        figure_kwargs={**SIZE, "figsize": (12, 2.6 * rows + 0.4)},
    )
    return _figure(collection, title)


def energy(statistics: xr.Dataset) -> Figure:
    """Energies of the draws about their mean, their changes from draw to draw, and BFMI."""
    title, energies = (
        "Energies; BFMI below 0.3: chains that move slowly",
        statistics["energy"],
    )
    if not _vary([energies.values]):
        return note(title, TOO_FEW)
    tree = arviz_base.from_dict({"sample_stats": {"energy": energies.values}})
    collection = arviz_plots.plot_energy(
        tree, backend="matplotlib", figure_kwargs={**SIZE, "figsize": (11, 3.6)}
    )
    return _figure(collection, title)


def pairs(quantities: Quantities) -> Figure:
    """Draws of the first quantities against each other."""
    chosen = dict(list(quantities.items())[:N_PAIRS])
    if not _vary(chosen.values()):
        return note("Pairs of quantities", TOO_FEW)
    side = 2.2 * len(chosen) + 0.6
    collection = arviz_plots.plot_pair(
        arviz_base.from_dict({"posterior": chosen}),
        visuals={"scatter": {"alpha": 0.3}, "divergence": False},
        backend="matplotlib",
        figure_kwargs={**SIZE, "figsize": (side, side)},
    )
    figure = _figure(collection, "Pairs of quantities")
    for axes in figure.axes:
        plain_ticks(axes, 3)
        axes.tick_params(labelsize=8)
        for label in (axes.xaxis.label, axes.yaxis.label):
            label.set(text=label.get_text().replace(" [", "\n["), size=9)
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


def _vary(quantities: Iterable[Float[np.ndarray, "chains draws"]]) -> bool:
    """Whether there are draws enough for ArviZ's estimates, and not all the same."""
    return all(
        draws.shape[1] >= FEWEST and bool((np.ptp(draws, axis=1) > 0).all()) for draws in quantities
    )


def _figure(collection: arviz_plots.PlotCollection, title: str) -> Figure:
    """The figure of a collection, which pyplot then forgets."""
    figure = collection.viz["figure"].item()
    figure.suptitle(title)
    pyplot.close(figure)
    return figure
