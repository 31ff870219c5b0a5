"""Receivers, ground and gain table against frequency."""

from __future__ import annotations

from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from lusee_bayes.report.figures.drawing import BLUE, GREY, ORANGE
from lusee_bayes.results.cube_unknowns import CubeUnknowns

COLUMNS = 4
# from where on a prior that changes with frequency hides what errors there are
WIDE = 3.0


def unknowns_by_frequency(unknowns: CubeUnknowns) -> Figure:
    """Draw every unknown of all channels with its error, its prior and, if known, the truth."""
    table = unknowns.table
    names = list(dict.fromkeys(table["unknown"]))
    n_rows = -(-len(names) // COLUMNS)
    figure = Figure(figsize=(13, 0.6 + 2.5 * n_rows), layout="constrained")
    panels = list(figure.subplots(n_rows, COLUMNS, squeeze=False).flat)
    for axes, name in zip(panels, names, strict=False):
        rows = table[table["unknown"] == name]
        f, value, std, prior, before = (
            rows[column].to_numpy()
            for column in ("frequency_mhz", "value", "std", "prior", "prior_std")
        )
        axes.fill_between(f, prior - before, prior + before, color=GREY, alpha=0.25, lw=0)
        axes.errorbar(f, prior, before, color=GREY, fmt="none", lw=4, alpha=0.4, label="prior")
        axes.errorbar(f, value, std, color=BLUE, fmt=".", ms=5, lw=1.2, label="posterior")
        if "true" in rows:
            axes.plot(f, rows["true"].to_numpy(), "x", color=ORANGE, ms=5, label="truth")
        axes.xaxis.set_major_locator(MaxNLocator(5))
        unit = rows["unit"].iloc[0] or "relative"
        axes.set(title=name, xlabel="frequency [MHz]", ylabel=unit)
        if prior.min() > 0.0 and prior.max() > WIDE * prior.min():
            axes.set_yscale("log")
    for axes in panels[len(names) :]:
        axes.set_axis_off()
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper right", ncols=3, frameon=False)
    return figure
