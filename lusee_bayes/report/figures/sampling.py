"""Figures of chains and draws: diagnostics and results."""

from collections.abc import Callable

import arviz_base
import arviz_plots
import numpy as np
from arviz_stats.base import array_stats
from jaxtyping import Float
from matplotlib import colors, pyplot
from matplotlib.figure import Figure

from lusee_bayes.judge.coverage import LEVELS
from lusee_bayes.report.figures import drawing
from lusee_bayes.results.sample_result import SampleResult
from lusee_bayes.sampling import least, validation

# style of a value for every mode
DOTS = {"ls": "", "marker": ".", "ms": 3, "color": drawing.BLUE}
# numbers of quantities in the figures: the first of a run's list; and of a chain's ranked draws
N_RANKS, N_PAIRS, RANKED = 8, 5, 1000
# sqrt(n) times the largest distance of two cumulative distributions: 99 % are smaller
KOLMOGOROV = 1.63
# fewest draws of a chain that give ranks and densities
FEWEST = 4
TOO_FEW = f"not drawn: a chain has fewer than {FEWEST} draws or did not move"

Quantities = dict[str, Float[np.ndarray, "chains draws"]]


def ranks(quantities: Quantities) -> Figure:
    """Ranks of each chain's draws among all: differences of their ECDFs from uniform ones.

    The grey band contains 99 % of the curves if chains agree (Kolmogorov's limit for the effective
    number of draws of each chain).
    """
    # more draws would overflow a cache of ArviZ's, and show no more
    shown = list(quantities.items())[:N_RANKS]
    chosen = {name: x[:, :: -(-x.shape[1] // RANKED)] for name, x in shown}
    size = (12, 2.6 * ((len(chosen) + 3) // 4) + 0.4)
    title = "Ranks among the draws of all chains, one curve per chain"
    # ArviZ's band spans everything for some numbers of draws
    bare = {"credible_interval": False}
    figure = _drawn(arviz_plots.plot_rank, chosen, title, size, visuals=bare)
    for axes, x in zip(figure.axes, chosen.values(), strict=False):
        effective = sum(array_stats.ess(one[None], chain_axis=0, draw_axis=1) for one in x)
        half = KOLMOGOROV * np.sqrt((len(x) - 1) / effective)
        axes.axhspan(-half, half, color=drawing.GREY, alpha=0.2, lw=0)
    return figure


def pairs(quantities: Quantities) -> Figure:
    """Draws of the first quantities against each other."""
    chosen = dict(list(quantities.items())[:N_PAIRS])
    side = 2.2 * len(chosen) + 0.6
    visuals = {"scatter": {"alpha": 0.3}, "divergence": False}
    size, title = (side, side), "Pairs of quantities"
    figure = _drawn(arviz_plots.plot_pair, chosen, title, size, visuals=visuals)
    for axes in figure.axes:
        drawing.plain_ticks(axes, 2)
        axes.tick_params(labelsize=7)
    return figure


def _drawn(
    plot: Callable[..., arviz_plots.PlotCollection],
    quantities: Quantities,
    title: str,
    size: drawing.Size,
    **options: object,
) -> Figure:
    """ArviZ's figure, closed in pyplot; a note if there are too few draws."""
    if any(x.shape[1] < FEWEST or not (np.ptp(x, axis=1) > 0).all() for x in quantities.values()):
        return drawing.note(title, TOO_FEW)
    tree = arviz_base.from_dict({"posterior": quantities})
    frame = {"layout": "constrained", "figsize": size}
    figure = plot(tree, backend="matplotlib", figure_kwargs=frame, **options).viz["figure"].item()
    figure.suptitle(title)
    pyplot.close(figure)
    return figure


def uncertainty(run: SampleResult) -> Figure | dict[str, Figure]:
    """Mean, standard deviation and 90 % interval of the drawn maps, and its asymmetry."""
    maps = run.maps
    if run.skies.shape[0] * run.skies.shape[1] < 2:
        why = "not drawn: a single draw has no standard deviation"
        return drawing.note("Uncertainty of the drawn maps", why)
    width = maps["upper"] - maps["lower"]
    excess = maps["upper"] + maps["lower"] - 2.0 * maps["mean"]
    # identical draws have no width, and no asymmetry
    skewness = np.divide(excess, width, out=np.zeros_like(width), where=width > 0)
    limit = np.percentile(np.abs(skewness), 99.0)
    skewed = colors.Normalize(-limit, limit), drawing.DIVERGING, "fraction of the width"
    panels = {"mean of the draws": (maps["mean"], drawing.temperatures(maps["mean"]))}
    spreads = {"standard deviation": maps["std"], "width of the 90 % interval": width}
    for title, kelvin in spreads.items():
        percent = 100.0 * kelvin / maps["mean"].mean()
        scale = colors.Normalize(*np.percentile(percent, [0.5, 99.5]))
        panels[title] = percent, scale, drawing.SEQUENTIAL, "% of the mean sky"
    panels["asymmetry of the 90 % interval about the mean"] = skewness, *skewed
    return drawing.sky_figures(panels, run.highest_altitude)


def traces(run: SampleResult) -> Figure:
    """Traces and histograms of the first eight of a run's quantities."""
    columns = list(run.quantities().items())[:8]
    size = (11, 1.7 * len(columns) + 0.8)
    figure, grid = drawing.framed(size, len(columns), 2, width_ratios=(3, 1), squeeze=False)
    for (left, right), (name, draws) in zip(grid, columns, strict=True):
        # a range of a few rounding errors cannot be divided into bins
        moved = np.ptp(draws) > 1e-12 * np.abs(draws).max()
        bins = np.histogram_bin_edges(draws, 40 if moved else 1)
        for number, chain in enumerate(draws):
            colour = drawing.COLOURS[number % len(drawing.COLOURS)]
            left.plot(chain, color=colour, lw=0.5, alpha=0.8)
            style = {"histtype": "step", "density": True, "label": f"chain {number}"}
            right.hist(chain, bins, color=colour, **style)
        drawing.plain_ticks(left)
        drawing.plain_ticks(right)
        left.set(ylabel=name.replace(" [", "\n["), xlim=(0, draws.shape[1]))
        left.yaxis.label.set_size(8)
        right.set(yticks=[])
        right.tick_params(labelsize=8)
    grid[0][1].legend(frameon=False, fontsize=7)
    grid[-1][0].set_xlabel("draw")
    figure.suptitle(f"Draws from {run.tree.attrs['program']}")
    return figure


def comparison(result: validation.Comparison) -> Figure:
    """HMC compared with the analytic posterior: means, variances, covariance, effective sizes."""
    figure, ((means, variances), (covariance, sizes)) = drawing.framed((11, 7), 2, 2)
    limit = result.checks[0].upper
    means.plot(result.mean_z, **DOTS)
    for bound in (-limit, limit):
        means.axhline(bound, color=drawing.ORANGE, ls="--", lw=1)
    means.set(xlabel="mode", ylabel="difference of means [Monte Carlo error]")
    means.set_title("Means of every mode")
    ratio, error = result.variance_ratio, result.variance_error
    variances.errorbar(np.arange(len(ratio)), ratio, error, elinewidth=0.3, **DOTS)
    variances.axhline(1.0, color=drawing.GREY, lw=0.8)
    variances.set(xlabel="mode", ylabel="variance: draws / analytic", title="Variances")
    rank = np.arange(1, len(result.eigenvalues) + 1)
    covariance.plot(rank, result.eigenvalues, color=drawing.BLUE, label="draws")
    exact = {"color": drawing.ORANGE, "ls": "--", "label": "exact chains"}
    covariance.plot(rank, result.null_eigenvalues, **exact)
    covariance.set(xlabel="rank, in increasing order", ylabel="generalised eigenvalue")
    covariance.set_title("Covariance in analytic coordinates")
    covariance.legend(frameon=False)
    sizes.semilogy(result.ess_bulk, label="bulk", **DOTS)
    sizes.semilogy(result.ess_tail, label="tail", **(DOTS | {"color": drawing.ORANGE}))
    sizes.set(xlabel="mode", ylabel="effective sample size", title="Effective sample sizes")
    sizes.legend(frameon=False)
    verdict = "passed" if result.passed else "FAILED"
    figure.suptitle(f"HMC compared with the analytic posterior: {verdict}")
    return figure


def rank_statistics(ranks: validation.Ranks) -> Figure:
    """Rank histograms, with a band that contains 99 % of the bins, and coverage by level."""
    shown = np.unique(np.linspace(0, len(ranks.names) - 1, 11).astype(int))
    figure, panels = drawing.framed((12, 7), 3, 4)
    low, high = ranks.band()
    centres = (np.arange(least.N_BINS) + 0.5) / least.N_BINS
    histogram, p_values = ranks.histogram(), ranks.p_values()
    for axes, k in zip(panels.flat, shown, strict=False):
        axes.bar(centres, histogram[k], 1.0 / least.N_BINS, color=drawing.BLUE, alpha=0.7)
        axes.axhspan(low, high, color=drawing.GREY, alpha=0.25, lw=0)
        axes.set_title(f"{ranks.names[k]}, p = {p_values[k]:.2g}", fontsize=9)
        axes.set(xlim=(0, 1), xticks=[0, 0.5, 1])
    *unused, last = panels.flat[len(shown) :]
    for axes in unused:
        axes.set_axis_off()
    levels = np.array(LEVELS)
    for coverage in ranks.coverage().values():
        last.plot(levels, [coverage[p] - p for p in LEVELS], color=drawing.BLUE, lw=0.5, alpha=0.6)
    error = 3 * np.array([ranks.coverage_error(p) for p in LEVELS])
    last.fill_between(levels, -error, error, color=drawing.GREY, alpha=0.25, lw=0)
    last.set(xlabel="level", title="coverage - level (band: 3 standard errors)")
    last.set_xticks(levels, [f"{p:.0%}" for p in LEVELS], fontsize=7, rotation=45)
    last.title.set_size(9)
    figure.supxlabel("rank of the truth among the draws")
    figure.supylabel("simulations per bin")
    verdict = "passed" if ranks.passed else "FAILED"
    figure.suptitle(f"Calibration over {ranks.n_simulations} simulations: {verdict}")
    return figure
