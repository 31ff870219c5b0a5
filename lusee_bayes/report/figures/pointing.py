"""Which offset of clock and pointing each day would prefer."""

from __future__ import annotations

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from lusee_bayes.report.figures.drawing import BLUE, GREY, ORANGE

# days whose errors are so many times the median of all are not shown: they would hide the others
TOO_WIDE = 20.0
# of the end of an offset's name
UNITS = {"s": "s", "day": "s/day", "deg": "degrees"}


def pointing_by_day(preferred: pd.DataFrame) -> Figure:
    """Draw the preferred value of every offset for each day, and for all of them together.

    Parameters
    ----------
    preferred : DataFrame
        As :class:`.PointingReport` has it.
    """
    names = list(dict.fromkeys(preferred["offset"]))
    figure = Figure(figsize=(12, 0.6 + 2.1 * len(names)), layout="constrained")
    panels = figure.subplots(len(names), 1, sharex=True, squeeze=False)[:, 0]
    for axes, name in zip(panels, names, strict=True):
        mine = preferred[preferred["offset"] == name]
        days, whole = mine[mine["first_day"] >= 0].dropna(), mine[mine["first_day"] < 0].dropna()
        days = days[days["std"] < TOO_WIDE * days["std"].median()]
        middle = (days["first_day"] + days["last_day"] + 1) / 2.0
        axes.axhline(0.0, color=GREY, lw=0.8)
        axes.errorbar(
            middle, days["value"], days["std"], fmt="o", ms=3, color=BLUE, label="each day"
        )
        if len(whole):
            value, std = float(whole["value"].iloc[0]), float(whole["std"].iloc[0])
            if np.isfinite(std) and std < TOO_WIDE * days["std"].median():
                axes.axhspan(value - std, value + std, color=ORANGE, alpha=0.3)
                axes.axhline(value, color=ORANGE, label="all days alike")
        kind, _, unit = name.rpartition("_")
        axes.set_ylabel(f"{kind.replace('_', ' ')} [{UNITS.get(unit, unit)}]")
    panels[0].legend(loc="upper right", ncols=2, frameon=False)
    panels[-1].set_xlabel("days since the first sample")
    figure.suptitle("Offset of clock and pointing that the data would prefer besides the model's")
    return figure
