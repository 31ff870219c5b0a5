"""Figures of one channel: its data, its beams, its maps and its spectra."""

from __future__ import annotations

import numpy as np
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure

from lusee_bayes.core.harmonics import lmax_of
from lusee_bayes.experiment.setup import Setup
from lusee_bayes.instrument.beams import HemisphereGrid
from lusee_bayes.instrument.visibilities import Visibilities
from lusee_bayes.linear.metrics import ell_cross
from lusee_bayes.report.figures.drawing import (
    BLUE,
    DIVERGING,
    GREY,
    ORANGE,
    SEQUENTIAL,
    colour_bar,
    orthographic,
    seen_range,
    without_minor_ticks,
)
from lusee_bayes.report.figures.mollweide import mollweide
from lusee_bayes.report.figures.taper import shown, taper_fwhm_deg
from lusee_bayes.results.channel import ChannelResult


def data_vector(data: Visibilities) -> Figure:
    """The data vector as the paper draws it: products side by side, time running within each."""
    figure = Figure(figsize=(11, 4))
    axes = figure.subplots(gridspec_kw={"left": 0.08, "right": 0.99, "bottom": 0.13, "top": 0.91})
    n_times = data.layout.n_times
    axes.plot(data.grid().ravel(), color=BLUE, lw=0.7)
    for k in range(1, data.layout.n_products):
        axes.axvline(k * n_times, color=GREY, lw=0.4)
    axes.set_xticks((np.arange(data.layout.n_products) + 0.5) * n_times, data.labels, fontsize=8)
    axes.tick_params(axis="x", length=0)
    axes.set(
        xlabel="product (time runs within each)",
        ylabel="visibility [K]",
        xlim=(0, n_times * data.layout.n_products),
        title=f"Data vector at {data.frequency_mhz:g} MHz, {data.layout.size} samples"
        + (f", {data.n_missing} missing" if data.n_missing else ""),
    )
    return figure


def beams(setup: Setup) -> Figure:
    """An auto and two crosses from above: zenith in the centre, North up, horizon at the rim."""
    frequency = setup.scenario.frequency_mhz
    grid = HemisphereGrid.gauss_legendre(48, 120)
    patterns = np.asarray(setup.beam_source.patterns(frequency, grid))
    names = {0: "auto 00", 2: "|cross 02|", 1: "|cross 01|"}
    if not setup.scenario.beam.is_file:
        names = {0: "auto 00 (North)", 2: "|cross 02| (opposite)", 1: "|cross 01| (perpendicular)"}
    panels = [(name, patterns[0, k]) for k, name in names.items() if k < len(patterns)]
    figure = Figure(figsize=(11, 4))
    places = {"left": 0.01, "right": 0.99, "bottom": 0.02, "top": 0.82, "wspace": 0.04}
    grid_of_axes = np.atleast_1d(figure.subplots(1, len(panels), gridspec_kw=places))
    for axes, (title, pattern) in zip(grid_of_axes, panels, strict=True):
        image = orthographic(axes, grid, pattern)
        axes.set_title(title)
    figure.colorbar(image, ax=figure.axes, label="beam / its peak", shrink=0.8, pad=0.02)
    figure.suptitle(f"Beams at {frequency:g} MHz, zenith at the centre")
    return figure


def maps(channel: ChannelResult) -> Figure:
    """Truth, posterior mean, residual over the mean temperature, and standard deviation.

    All but the standard deviation are drawn through the beam of :mod:`.taper`.
    """
    sky = mean = shown(channel.mean, channel.nside)
    level, extra = mean.mean(), {}
    if channel.truth is not None:
        sky = shown(channel.truth, channel.nside)
        percent = 100.0 * (mean - sky) / level
        span = np.percentile(np.abs(percent), 99.0)
        extra = {"mean - truth": (percent, Normalize(-span, span), DIVERGING, "% of the mean sky")}
    positive = np.percentile(sky[sky > 0], [0.05, 99.8])
    temperature = (LogNorm(*positive), SEQUENTIAL, "K")
    bounds = LogNorm(*seen_range(channel.pixel_std, channel.highest_altitude))
    panels = {
        **({"truth": (sky, *temperature)} if extra else {}),
        "posterior mean": (mean, *temperature),
        **extra,
        "posterior standard deviation": (channel.pixel_std, bounds, SEQUENTIAL, "K"),
    }
    rows = (len(panels) + 1) // 2
    figure = Figure(figsize=(12, 3.6 * rows))
    places = {"left": 0.01, "right": 0.98, "bottom": 0.01, "top": 0.88, "wspace": 0.06}
    grid_of_axes = figure.subplots(rows, 2, gridspec_kw=places | {"hspace": 0.12}).ravel()
    for axes, (title, (pixels, norm, cmap, unit)) in zip(grid_of_axes, panels.items(), strict=True):
        image = mollweide(
            axes, pixels, norm=norm, cmap=cmap, highest_altitude=channel.highest_altitude
        )
        colour_bar(figure, image, axes, label=unit, shrink=0.8, extend="both", pad=0.03)
        axes.set_title(title)
    figure.suptitle(
        f"{channel.frequency_mhz:g} MHz, Galactic coordinates; dashed: never above the horizon\n"
        f"{', '.join(list(panels)[:-1])}: seen through a beam of "
        f"{taper_fwhm_deg(lmax_of(len(channel.mean))):.1f}° (FWHM)"
    )
    return figure


def fidelity(channel: ChannelResult) -> Figure:
    """rho_ell and SNR_ell where the truth is known, and how much of each ell the prior supplies."""
    spectra = channel.spectra()
    known = "snr" in spectra
    figure = Figure(figsize=(12 if known else 5, 4))
    places = {"left": 0.06 if known else 0.14, "right": 0.98, "bottom": 0.13, "top": 0.9}
    axes = np.atleast_1d(
        figure.subplots(1, 3 if known else 1, gridspec_kw=places | {"wspace": 0.25})
    )
    ell = spectra["ell"][1:]
    axes[-1].plot(ell, spectra["prior_fraction"][1:], color=BLUE)
    axes[-1].axhline(0.5, color=GREY, lw=0.8, ls=":")
    axes[-1].set(ylabel="share of the variance from the prior", ylim=(0, 1.02))
    if known:
        axes[0].plot(ell, spectra["rho"][1:], color=BLUE)
        axes[0].axhline(0.0, color=GREY, lw=0.8)
        axes[0].set(ylabel=r"correlation with the truth $\rho_\ell$", ylim=(-0.25, 1.05))
        axes[1].semilogy(ell, spectra["snr"][1:], color=BLUE)
        axes[1].axhline(1.0, color=GREY, lw=0.8, ls=":")
        axes[1].set(ylabel=r"$\mathrm{SNR}_\ell$")
        without_minor_ticks(axes[1].yaxis)
        cross = ell_cross(spectra["snr"])
        if cross is not None:
            axes[1].axvline(cross, color=ORANGE, lw=1, ls="--", label=f"first below 1: {cross}")
            axes[1].legend(frameon=False)
    for panel in axes:
        panel.set(xlabel=r"multipole $\ell$", xlim=(1, ell[-1]))
    figure.suptitle(f"Fidelity at {channel.frequency_mhz:g} MHz")
    return figure


def spectra(channel: ChannelResult) -> Figure:
    """C_ell of prior, posterior mean, truth and posterior variance."""
    columns = channel.spectra()
    figure = Figure(figsize=(6, 4.5))
    axes = figure.subplots(gridspec_kw={"left": 0.13, "right": 0.97, "bottom": 0.12, "top": 0.92})
    ell = columns["ell"]
    styles = {
        "cl_prior": ("prior", GREY, "-"),
        "cl_truth": ("truth", "black", ":"),
        "cl_mean": ("posterior mean", BLUE, "-"),
        "cl_posterior_variance": ("posterior variance", ORANGE, "--"),
    }
    for name, (label, colour, line) in styles.items():
        if name in columns:
            axes.semilogy(ell, columns[name], color=colour, ls=line, label=label)
    axes.set(xlabel=r"multipole $\ell$", ylabel=r"$C_\ell$ [K$^2$]", xlim=(0, ell[-1]))
    without_minor_ticks(axes.yaxis)
    axes.legend(frameon=False)
    axes.set_title(f"Power at {channel.frequency_mhz:g} MHz")
    return figure
