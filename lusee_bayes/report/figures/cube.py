"""Figures of a run of several frequencies."""

from __future__ import annotations

import numpy as np
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullLocator

from lusee_bayes.report.figures.drawing import (
    BLUE,
    GREY,
    ORANGE,
    SEQUENTIAL,
    colour_bar,
    seen_range,
)
from lusee_bayes.report.figures.mollweide import mollweide
from lusee_bayes.results.cube import CubeResult

# channels whose maps are drawn
SHOWN = 3


def maps(cube: CubeResult) -> Figure:
    """Posterior mean and standard deviation of a few channels from the lowest to the highest."""
    n = len(cube.frequencies_mhz)
    shown = np.unique(np.linspace(0, n - 1, min(n, SHOWN)).round().astype(int))
    mean, pixel_std = cube.maps()["mean"], cube.stacked("pixel_std")
    figure = Figure(figsize=(12, 3.4 * len(shown) + 0.4), layout="constrained")
    for row, k in enumerate(shown):
        positive = LogNorm(*np.percentile(mean[k][mean[k] > 0], [0.5, 99.8]))
        altitude = cube.channels[k].highest_altitude
        spread = LogNorm(*seen_range(pixel_std[k], altitude))
        for column, (title, pixels, norm, unit) in enumerate(
            (
                ("posterior mean", mean[k], positive, "K"),
                ("standard deviation", pixel_std[k], spread, "K"),
            )
        ):
            axes = figure.add_subplot(len(shown), 2, 2 * row + column + 1)
            image = mollweide(axes, pixels, norm=norm, highest_altitude=altitude)
            colour_bar(figure, image, axes, label=unit, shrink=0.85, extend="both")
            axes.set_title(f"{cube.frequencies_mhz[k]:g} MHz: {title}")
    return figure


def spectra(cube: CubeResult) -> Figure:
    """Brightness against frequency in some directions, with one standard deviation."""
    landmarks = cube.landmarks()
    figure = Figure(figsize=(11, 7), layout="constrained")
    for axes, (name, values) in zip(
        figure.subplots(2, 2, sharex=True).flat, landmarks.items(), strict=True
    ):
        f, mean, std = cube.frequencies_mhz, values["mean"], values["std"]
        axes.errorbar(f, mean, std, color=BLUE, fmt=".", ms=4, lw=1, label="posterior")
        if "truth" in values:
            axes.plot(f, values["truth"], color=ORANGE, ls="--", lw=1.2, label="truth")
        axes.set(title=name, yscale="log", xscale="log", xlim=(0.93 * f[0], 1.07 * f[-1]))
        axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axes.xaxis.set_major_formatter(lambda value, _: f"{value:g}")
        axes.xaxis.set_minor_locator(NullLocator())
        axes.set(xlabel="frequency [MHz]", ylabel="brightness temperature [K]")
    axes.legend(frameon=False)
    return figure


def fidelity(cube: CubeResult) -> Figure:
    """SNR_ell (or, without a truth, the prior's share) over frequency and ell, and its mean."""
    snr, alone = cube.snr(), cube.snr(independent=True)
    known = snr is not None
    values = snr if known else cube.stacked("prior_fraction")
    label = r"$\mathrm{SNR}_\ell$" if known else "share of the variance from the prior"
    norm = LogNorm(0.3, 30.0) if known else Normalize(0.0, 1.0)
    figure = Figure(figsize=(12, 4.4), layout="constrained")
    left, right = figure.subplots(1, 2)
    ell, channel = np.arange(values.shape[1]), np.arange(values.shape[0])
    image = left.pcolormesh(
        ell[1:], channel, values[:, 1:], norm=norm, cmap=SEQUENTIAL, shading="nearest"
    )
    shown = np.unique(np.linspace(0, len(channel) - 1, min(len(channel), 8)).round().astype(int))
    left.set_yticks(shown, [f"{cube.frequencies_mhz[k]:g}" for k in shown])
    left.set(xlabel=r"multipole $\ell$", ylabel="frequency [MHz]", title=label)
    figure.colorbar(image, ax=left, label=label, extend="both" if known else "neither")
    right.plot(ell[1:], values[:, 1:].mean(0), color=BLUE, label="this run")
    if alone is not None:
        right.plot(
            ell[1:], alone[:, 1:].mean(0), color=ORANGE, ls="--", label="every channel on its own"
        )
    if known:
        right.set_yscale("log")
        right.axhline(1.0, color=GREY, lw=0.8, ls=":")
    right.set(xlabel=r"multipole $\ell$", ylabel=label, title="mean over channels")
    right.legend(frameon=False)
    return figure


def chi2(cube: CubeResult) -> Figure:
    """chi^2 that judges every channel, over its mean if the model holds."""
    figure = Figure(figsize=(8, 4), layout="constrained")
    axes = figure.subplots()
    fits = cube.fits()
    ratio, width = fits.chi2 / fits.degrees, np.sqrt(2.0 / fits.degrees)
    axes.fill_between(
        cube.frequencies_mhz, 1 - 2 * width, 1 + 2 * width, color=GREY, alpha=0.3, lw=0
    )
    axes.axhline(1.0, color=GREY, lw=0.8)
    axes.plot(cube.frequencies_mhz, ratio, "o", ms=4, color=BLUE)
    if np.isfinite(ratio).all() and ratio.max() > 3.0:
        axes.set_yscale("log")
    axes.set(xlabel="frequency [MHz]", ylabel=r"$\chi^2$ / its mean if the model holds")
    return figure
