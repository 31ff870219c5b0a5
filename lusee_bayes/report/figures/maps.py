"""Figures of maps, spectra and fidelity for a channel, a cube, or several finished runs."""

from collections.abc import Mapping, Sequence
from dataclasses import astuple
from itertools import cycle
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator

from lusee_bayes.core import arrays, harmonics, reading
from lusee_bayes.experiment.unknowns import ALL_TOGETHER
from lusee_bayes.instrument.beams.fields import HemisphereGrid
from lusee_bayes.judge.measures import ell_cross
from lusee_bayes.linear.posterior import Posterior, pixel_std
from lusee_bayes.report.figures import drawing
from lusee_bayes.report.figures.drawing import BLUE, COLOURS, DIVERGING, GREY, LINES, ORANGE
from lusee_bayes.results.channel import ChannelResult
from lusee_bayes.results.finished_runs import FinishedRun
from lusee_bayes.results.map_result import MapResult
from lusee_bayes.results.sky_spectrum import MEASURED, PUBLISHED, REGIONS, Frequencies, SkySpectrum

# figures shown side by side, or below each other on a phone, by their titles
Panels = dict[str, Figure]
# smallest NSIDE of maps that are drawn
NSIDE = 64


def data_vector(result: MapResult) -> Figure | None:
    """The data vector as in the paper: products side by side, time running within each."""
    if not result.single:
        return None
    channel = result.channel
    figure, (axes,) = drawing.in_places((11, 4), left=0.095, right=0.99, bottom=0.13, top=0.91)
    drawing.side_by_side(axes, channel.data, channel.labels)
    missing = f", {channel.n_missing} missing" if channel.n_missing else ""
    samples = f"{channel.n_data} samples{missing}"
    axes.set_title(f"Data vector at {channel.frequency_mhz:g} MHz, {samples}")
    return figure


def beams(result: MapResult) -> Figure | None:
    """An auto and two crosses from above: zenith at the centre, North up, horizon at the rim."""
    if (details := result.channel.details) is None:
        return None
    grid = HemisphereGrid.gauss_legendre(*details.patterns.shape[1:])
    places = {"left": 0.01, "right": 0.99, "bottom": 0.02, "top": 0.82, "wspace": 0.04}
    figure, grid_of_axes = drawing.in_places((11, 4), 1, len(details.patterns), **places)
    named = zip(grid_of_axes, details.pattern_names, details.patterns, strict=True)
    for axes, title, pattern in named:
        image = drawing.orthographic(axes, grid, pattern)
        axes.set_title(title)
    figure.colorbar(image, ax=figure.axes, label="beam / peak", shrink=0.8, pad=0.02)
    figure.suptitle(f"Beams at {result.channel.frequency_mhz:g} MHz, zenith at the centre")
    return figure


def draws(result: MapResult) -> Panels | None:
    """A few samples from the posterior as Galactic maps, on the scale of the mean."""
    channel = result.channel
    if channel.details is None:
        return None
    norm, nside = scales(channel)["temperature"], max(NSIDE, channel.nside)
    panels = {
        f"draw {k}": (drawing.shown(sky, nside), norm)
        for k, sky in enumerate(channel.details.draws, 1)
    }
    return drawing.sky_figures(panels, channel.highest_altitude)


def sky_maps(result: MapResult) -> Panels:
    """The maps of one channel, or of some of the channels of a cube."""
    if result.single:
        channel = result.channel
        return drawing.sky_figures(channel_panels(channel), channel.highest_altitude)
    figures: Panels = {}
    for channel in (result.channels[k] for k in _few_of(len(result.channels), SHOWN)):
        panels, mhz = channel_panels(channel), f"{channel.frequency_mhz:g} MHz"
        posterior = {f"{mhz}: {t}": p for t, p in panels.items() if t.startswith("posterior")}
        figures |= drawing.sky_figures(posterior, channel.highest_altitude)
    return figures


def spectra(result: MapResult) -> Figure | Panels:
    """Power spectra of one channel, or brightness against frequency of several."""
    return sky_spectra(result.channel) if result.single else channel_spectra(result)


def plot_map(sky: MapResult | Posterior | arrays.Modes, nside: int = 64) -> Figure:
    """Draw a sky, or mean and standard deviation of a posterior.

    Parameters
    ----------
    sky : MapResult, Posterior, Sky or (modes,) array
        Real harmonic coefficients, Galactic, in K, drawn through the beam that the title states.
        For a result (``lb.run_map(...).result``), the first channel is drawn, with truth and
        residual if known, and the region that never rises.
    nside : int
        HEALPix resolution of the drawn map; a result has its own.

    Returns
    -------
    Figure
        A Matplotlib figure: ``savefig(path)`` writes it.
    """
    if isinstance(sky, MapResult):
        return channel_map(sky.channel)
    modes = sky.mean if isinstance(sky, Posterior) else getattr(sky, "modes", sky)
    pixels = drawing.shown(np.asarray(modes), nside)
    width = harmonics.taper_fwhm_deg(max(harmonics.lmax_of(len(modes)), 1))
    name = "posterior mean" if isinstance(sky, Posterior) else "sky"
    panels = {f"{name}, beam {width:.1f}° (FWHM)": (pixels, drawing.temperatures(pixels))}
    if isinstance(sky, Posterior):
        std = pixel_std(np.asarray(sky.covariance()), nside)
        panels["posterior standard deviation"] = std, LogNorm(*np.percentile(std, [0.5, 99.5]))
    figure, places = drawing.framed((6 * len(panels), 3.6), 1, len(panels), squeeze=False)
    for axes, (title, panel) in zip(places[0], panels.items(), strict=True):
        drawing.sky_panel(axes, title, *panel, shrink=0.8, pad=0.03)
    return figure


def scales(channel: ChannelResult) -> dict[str, Normalize]:
    """The colour scales of a channel's maps, in figures and in the viewer, by quantity."""
    nside, altitude = max(NSIDE, channel.nside), channel.highest_altitude
    sky = mean = drawing.shown(channel.mean, nside)
    norms = {}
    if channel.truth is not None:
        sky = drawing.shown(channel.truth, nside)
        span = 100.0 * np.percentile(np.abs(mean - sky), 99.0) / mean.mean()
        norms["residual"] = Normalize(-span, span)
    norms["temperature"] = drawing.temperatures(sky)
    norms["std"] = LogNorm(*drawing.seen_range(channel.pixel_std, altitude))
    if channel.details is not None:
        share = np.percentile(channel.details.prior_fraction, [0.5, 99.5])
        norms["prior_fraction"] = Normalize(*share)
    return norms


def channel_panels(channel: ChannelResult) -> dict[str, tuple]:
    """Truth, posterior mean, residual relative to the mean temperature, and standard deviation.

    All except the standard deviation are smoothed with the beam of :mod:`.drawing`.
    """
    nside, norms = max(NSIDE, channel.nside), scales(channel)
    mean = drawing.shown(channel.mean, nside)
    panels = {"posterior mean": (mean, norms["temperature"])}
    if channel.truth is not None:
        truth = drawing.shown(channel.truth, nside)
        percent = 100.0 * (mean - truth) / mean.mean()
        panels = {"truth": (truth, norms["temperature"]), **panels}
        panels["mean - truth"] = percent, norms["residual"], DIVERGING, "% of the mean sky"
    return panels | {"posterior standard deviation": (channel.pixel_std, norms["std"])}


def channel_map(channel: ChannelResult) -> Figure:
    """:func:`channel_panels` in one figure."""
    panels, altitude = channel_panels(channel), channel.highest_altitude
    rows = (len(panels) + 1) // 2
    places = {"left": 0.01, "right": 0.98, "bottom": 0.01, "top": 0.88, "wspace": 0.06}
    figure, grid_of_axes = drawing.in_places((12, 3.6 * rows), rows, 2, **places, hspace=0.12)
    for axes, (title, panel) in zip(grid_of_axes, panels.items(), strict=True):
        drawing.sky_panel(axes, title, *panel, altitude=altitude, shrink=0.8, pad=0.03)
    figure.suptitle(
        f"{channel.frequency_mhz:g} MHz, Galactic coordinates; dashed: region that never rises\n"
        f"{', '.join(list(panels)[:-1])}: smoothed with a beam of "
        f"{harmonics.taper_fwhm_deg(harmonics.lmax_of(len(channel.mean))):.1f}° (FWHM)"
    )
    return figure


def map_fidelity(channels: Mapping[str, ChannelResult]) -> Panels:
    """rho_ell and SNR_ell if the truth is known, and the prior's share of each ell's variance.

    One curve for each channel, by its label; for a single one, also the first ell with SNR < 1.
    """
    spectra = {label: channel.spectra() for label, channel in channels.items()}
    with_truth = all("snr" in columns for columns in spectra.values())
    names = ["correlation", "signal-to-noise", "share of the prior"][0 if with_truth else 2 :]
    drawn = {name: drawing.framed((5, 3.6)) for name in names}
    *fidelity, share = [axes for _, axes in drawn.values()]
    for k, (label, columns) in enumerate(spectra.items()):
        style = {"color": COLOURS[k % len(COLOURS)], "ls": LINES[k % len(LINES)], "label": label}
        ell = columns["ell"][1:]
        share.plot(ell, columns["prior_fraction"][1:], **style)
        for axes, name in zip(fidelity, ("rho", "snr"), strict=False):
            axes.plot(ell, columns[name][1:], **style)
    share.set(ylabel="fraction of the variance from the prior", ylim=(0, 1.02))
    share.axhline(0.5, color=GREY, lw=0.8, ls=":")
    if with_truth:
        rho, snr = fidelity
        rho.set(ylabel=r"correlation with the truth $\rho_\ell$", ylim=(-0.25, 1.05))
        rho.axhline(0.0, color=GREY, lw=0.8)
        snr.set(ylabel=r"$\mathrm{SNR}_\ell$", yscale="log")
        snr.axhline(1.0, color=GREY, lw=0.8, ls=":")
        # over many decades they are slow to draw
        snr.yaxis.minorticks_off()
        if len(channels) == 1 and (cross := ell_cross(columns["snr"])) is not None:
            snr.axvline(cross, color=ORANGE, lw=1, ls="--", label=f"first below 1: {cross}")
            snr.legend(frameon=False)
    lmax = max(columns["ell"][-1] for columns in spectra.values())
    for axes in (*fidelity, share):
        axes.set(xlabel=r"multipole $\ell$", xlim=(1, lmax))
        if len(channels) > 1:
            axes.legend(frameon=False, fontsize=8)
    return {name: figure for name, (figure, _) in drawn.items()}


def sky_spectra(channel: ChannelResult) -> Figure:
    """C_ell of prior, posterior mean, truth and posterior variance."""
    columns = channel.spectra()
    figure, (axes,) = drawing.in_places((6, 4.5), left=0.13, right=0.97, bottom=0.12, top=0.92)
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
    axes.yaxis.minorticks_off()
    axes.legend(frameon=False)
    axes.set_title(f"Power at {channel.frequency_mhz:g} MHz")
    return figure


# number of channels whose maps are drawn
SHOWN = 3


def _few_of(n: int, most: int) -> np.ndarray:
    """At most ``most`` evenly spaced indices from the first to the last of n."""
    return np.unique(np.linspace(0, n - 1, min(n, most)).round().astype(int))


def instrument_share(result: MapResult) -> Panels | None:
    """Share of each pixel's variance that comes from unknowns of the instrument."""
    with_theta = [channel for channel in result.channels if channel.theta is not None]
    figures = {}
    for channel in (with_theta[k] for k in _few_of(len(with_theta), SHOWN)):
        share, title = 100.0 * channel.theta.pixel_share, f"{channel.frequency_mhz:g} MHz"
        scale = Normalize(0.0, max(float(np.percentile(share, 99.5)), 1e-3))
        options = {"altitude": channel.highest_altitude, "unit": "% of the variance"}
        figures[title] = drawing.sky_figure(title, share, scale, **options)
    return figures or None


def maps_of_runs(runs: Sequence[FinishedRun]) -> Panels:
    """Posterior mean and standard deviation of every run, on common scales."""
    channels = [run.channel for run in runs]
    lmax = min(harmonics.lmax_of(len(one.mean)) for one in channels)
    means = [drawing.shown(one.mean, max(NSIDE, one.nside), lmax) for one in channels]
    bounds = [drawing.seen_range(one.pixel_std, one.highest_altitude) for one in channels]
    spread = LogNorm(min(low for low, _ in bounds), max(high for _, high in bounds))
    level, figures = drawing.temperatures(np.concatenate(means)), {}
    for run, mean in zip(runs, means, strict=True):
        panels = {
            f"{run.name}: posterior mean": (mean, level),
            f"{run.name}: standard deviation": (run.channel.pixel_std, spread),
        }
        figures |= drawing.sky_figures(panels, run.channel.highest_altitude)
    return figures


def channel_spectra(cube: MapResult) -> Panels:
    """Brightness against frequency in some directions, with error bars of one sigma."""
    figures: Panels = {}
    for name, values in cube.landmarks().items():
        figures[name], axes = drawing.framed((5.6, 3.6))
        f, mean, std = cube.frequencies_mhz, values["mean"], values["std"]
        axes.errorbar(f, mean, std, color=BLUE, fmt=".", ms=4, lw=1, label="posterior")
        if "truth" in values:
            axes.plot(f, values["truth"], color=ORANGE, ls="--", lw=1.2, label="truth")
        axes.set(title=name, yscale="log", ylabel="brightness temperature [K]")
        _over_frequencies(axes, f)
    return figures


def spectrum_figure(spectrum: SkySpectrum, tables: Sequence[Path] = ()) -> Figure:
    """Draw the temperature of each region with error bars, beside published and given spectra.

    Parameters
    ----------
    spectrum : SkySpectrum
    tables : sequence of Path
        CSV files with ``frequency_mhz``, ``temperature_k`` and, if known, ``std_k``.

    Raises
    ------
    InputError
        If a table cannot be read.
    """
    f = spectrum.frequency
    grid = np.geomspace(f.min(), f.max(), 200)
    figure, axes = drawing.framed((5.6, 4.6))
    for k, (region, std) in enumerate(zip(REGIONS, spectrum.std, strict=False)):
        style = {"color": f"C{k}", "fmt": ".", "ms": 4, "lw": 1, "label": region}
        axes.errorbar(f, spectrum.temperature[k], std, **style)
        if spectrum.truth is not None:
            label = "truth" if not k else None
            axes.plot(f, spectrum.truth[k], color="black", ls=":", lw=1, label=label)
    for (name, (law, measured)), line in zip(PUBLISHED.items(), ("-", "--"), strict=True):
        if (inside := (grid >= measured[0]) & (grid <= measured[1])).any():
            axes.plot(grid[inside], law(grid[inside]), color=GREY, ls=line, lw=1, label=name)
    for path, marker in zip(tables, cycle("sD^v")):
        table = reading.read_table(path, MEASURED)
        values = table["frequency_mhz"], table["temperature_k"], table.get("std_k")
        axes.errorbar(*values, color="black", fmt=marker, mfc="none", ms=5, lw=1, label=path.stem)
    axes.set(ylabel="brightness temperature [K]", yscale="log")
    _over_frequencies(axes, f)
    return figure


def sky_spectrum(cube: MapResult) -> Panels | None:
    """Temperature of each region with error bars, and errors of the mean sky by source."""
    if cube.single:
        return None
    spectrum = cube.sky_spectrum()
    f = spectrum.frequency
    errors, lower = drawing.framed((5.6, 4.6))
    mean = 100.0 * spectrum.std[0] / spectrum.temperature[0]
    lower.plot(f, mean, color="black", label=f"standard deviation, {spectrum.regions[0]}")
    for name, shares in zip(spectrum.sources, spectrum.shares[:, 0], strict=True):
        if name != ALL_TOGETHER:
            lower.plot(f, mean * np.sqrt(shares), marker=".", lw=1, label=f"from {name}")
    if spectrum.truth is not None:
        off = spectrum.temperature[0] - spectrum.truth[0]
        lower.plot(f, 100.0 * np.abs(off) / spectrum.temperature[0], "k:", label="|mean - truth|")
    lower.set(ylabel="% of the temperature", yscale="log", ylim=(mean.min() / 50.0, None))
    _over_frequencies(lower, f)
    return {"temperature": spectrum_figure(spectrum), "errors": errors}


def _over_frequencies(axes: Axes, f: Frequencies) -> None:
    axes.legend(frameon=False, fontsize="small")
    axes.set(xlabel="frequency [MHz]", xscale="log", xlim=(0.93 * f.min(), 1.07 * f.max()))
    axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.xaxis.set_major_formatter(lambda value, _: f"{value:g}")
    axes.xaxis.minorticks_off()


def spectral_index(cube: MapResult) -> Panels | None:
    """Maps of the spectral index, its error, and the turnover where the draws agree on one."""
    if (found := cube.index_maps()) is None:
        return None
    at, figures = f"at {found.reference_mhz:.3g} MHz", {}
    titles = {"index": f"index {at}", "index_std": f"error of the index {at}"}
    for name, title in (titles | {"turnover": "turnover"}).items():
        pixels, unit = found.maps[name], "MHz" if name == "turnover" else ""
        if np.isfinite(pixels).any():
            scale = Normalize(*np.nanpercentile(pixels, (2, 98)))
            figures[title] = drawing.sky_figure(title, pixels, scale, unit=unit)
    return figures


def fidelity(cube: MapResult) -> Figure | Panels:
    """SNR_ell (or, without a truth, the prior's share) over frequency and ell, and its mean.

    For a map of one frequency, as :func:`map_fidelity`.
    """
    if cube.single:
        return map_fidelity({"": cube.channel})
    with_truth = cube.stacked("snr") is not None
    values = cube.stacked("snr" if with_truth else "prior_fraction")
    label = r"$\mathrm{SNR}_\ell$" if with_truth else "fraction of the variance from the prior"
    norm = LogNorm(0.3, max(30.0, values[:, 1:].max())) if with_truth else Normalize(0.0, 1.0)
    figure, (left, right) = drawing.framed((12, 4.4), 1, 2)
    ell, channel = np.arange(values.shape[1]), np.arange(values.shape[0])
    style = {"norm": norm, "cmap": drawing.SEQUENTIAL, "shading": "nearest"}
    image = left.pcolormesh(ell[1:], channel, values[:, 1:], **style)
    ticks = _few_of(len(channel), 8)
    left.set_yticks(ticks, [f"{cube.frequencies_mhz[k]:g}" for k in ticks])
    left.set(xlabel=r"multipole $\ell$", ylabel="frequency [MHz]", title=label)
    figure.colorbar(image, ax=left, label=label, extend="min" if with_truth else "neither")
    right.plot(ell[1:], values[:, 1:].mean(0), color=BLUE, label="this run")
    if with_truth and cube.stacked("independent") is not None:
        alone = np.mean([channel.spectra()["snr_independent"] for channel in cube.channels], 0)
        style = {"color": ORANGE, "ls": "--", "label": "each channel independently"}
        right.plot(ell[1:], alone[1:], **style)
    if with_truth:
        right.set_yscale("log")
        right.axhline(1.0, color=GREY, lw=0.8, ls=":")
    right.set(xlabel=r"multipole $\ell$", ylabel=label, title="mean over channels")
    right.legend(frameon=False)
    return figure


def chi2(cube: MapResult) -> Figure | None:
    """chi^2 of every channel (instrument + noise), relative to its expectation."""
    if cube.single:
        return None
    figure, axes = drawing.framed((8, 4))
    chi2, degrees = np.transpose([astuple(channel.instrument) for channel in cube.channels])
    ratio, width, mhz = chi2 / degrees, np.sqrt(2.0 / degrees), cube.frequencies_mhz
    axes.fill_between(mhz, 1 - 2 * width, 1 + 2 * width, color=GREY, alpha=0.3, lw=0)
    axes.axhline(1.0, color=GREY, lw=0.8)
    axes.plot(mhz, ratio, "o", ms=4, color=BLUE)
    if np.isfinite(ratio).all() and ratio.max() > 3.0:
        axes.set_yscale("log")
    axes.set(xlabel="frequency [MHz]", ylabel=r"$\chi^2$ / its expectation")
    return figure
