"""Figures that compare forecasts."""

from collections.abc import Sequence

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from lusee_bayes.report.figures.drawing import COLOURS, GREY, framed
from lusee_bayes.results.forecast import AS_GIVEN, Forecast

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
        places = {row: y + 0.2 * (number - (len(sources) - 1) / 2) for row, y in rows.items()}
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
    axes[0].set_yticks(list(rows.values()), [name or family for family, name in rows], fontsize=9)
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
    if (reference := getattr(mine[0], name)) is not None:
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
