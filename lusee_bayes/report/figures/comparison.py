"""Figures of several finished runs: their maps on one scale, their curves in one panel."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure

from lusee_bayes.report.figures.drawing import GREY, colour_bar, seen_range
from lusee_bayes.report.figures.mollweide import mollweide
from lusee_bayes.results.finished_runs import FinishedRun

# distinct without colour vision (Okabe-Ito), and by their lines
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#000000")
LINES = ("-", "--", "-.", ":")


def maps(runs: Sequence[FinishedRun]) -> Figure:
    """Posterior mean and standard deviation of every run, each kind on one scale."""
    means = np.concatenate([run.mean for run in runs])
    positive = LogNorm(*np.percentile(means[means > 0], [0.5, 99.8]))
    bounds = [seen_range(run.std, run.diagnostics["highest_altitude"].values) for run in runs]
    spread = LogNorm(min(low for low, _ in bounds), max(high for _, high in bounds))
    figure = Figure(figsize=(12, 3.4 * len(runs) + 0.4), layout="constrained")
    for row, run in enumerate(runs):
        altitude = run.diagnostics["highest_altitude"].values
        for column, (title, pixels, norm) in enumerate(
            (("mean", run.mean, positive), ("standard deviation", run.std, spread))
        ):
            axes = figure.add_subplot(len(runs), 2, 2 * row + column + 1)
            image = mollweide(axes, pixels, norm=norm, highest_altitude=altitude)
            colour_bar(figure, image, axes, label="K", shrink=0.85, extend="both")
            axes.set_title(f"{run.name}: {title}")
    return figure


def curves(runs: Sequence[FinishedRun]) -> Figure:
    """rho_ell and SNR_ell where the truth is known, and the prior's share, of every run."""
    known = all("snr" in run.spectra for run in runs)
    figure = Figure(figsize=(12 if known else 6, 4.2), layout="constrained")
    panels = np.atleast_1d(figure.subplots(1, 3 if known else 1))
    for k, run in enumerate(runs):
        style = {"color": COLOURS[k % len(COLOURS)], "ls": LINES[k % len(LINES)], "lw": 1.3}
        ell = run.spectra["ell"][1:]
        panels[-1].plot(ell, run.spectra["prior_fraction"][1:], label=run.name, **style)
        if known:
            panels[0].plot(ell, run.spectra["rho"][1:], **style)
            panels[1].semilogy(ell, run.spectra["snr"][1:], **style)
    panels[-1].set(ylabel="share of the variance from the prior", ylim=(0, 1.02))
    if known:
        panels[0].set(ylabel=r"correlation with the truth $\rho_\ell$", ylim=(-0.25, 1.05))
        panels[1].set(ylabel=r"$\mathrm{SNR}_\ell$")
        panels[1].axhline(1.0, color=GREY, lw=0.8)
    for axes in panels:
        axes.set(xlabel=r"multipole $\ell$")
    panels[-1].legend(frameon=False, fontsize=8)
    return figure
