"""Draw the documentation's figures and print its tables.

Run from the repository's root: python docs/make_figures.py [NAME...]
Without the name of a function or more, all are called. Those of the gallery take ten minutes.
Measured and modelled skies are in ../shared/data; where they are not, the embedded sky is drawn.
Figures of coverage are benchmarks/skies.py's.
The figure of the regolith needs the draws of
    lusee-bayes sample regolith --draws 320 --warmup 80 -o output/regolith
"""

from __future__ import annotations

import sys
from dataclasses import replace
from io import BytesIO
from pathlib import Path
from tempfile import TemporaryDirectory

import astropy.units as u
import h5py
import numpy as np
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure
from PIL import Image
from scipy.stats import norm

import lusee_bayes as lb
from lusee_bayes.core.harmonics import modes_to_map, power_spectrum
from lusee_bayes.experiment.experiment import Experiment
from lusee_bayes.experiment.model import base_model, set_up, true_values
from lusee_bayes.experiment.rounds import Inference
from lusee_bayes.experiment.validity import blind_spots
from lusee_bayes.flight.reduced import PRODUCT, REASONS
from lusee_bayes.instrument.pointing import Pointing
from lusee_bayes.judge.coverage import latitudes
from lusee_bayes.judge.measures import ell_cross, signal_to_noise
from lusee_bayes.report.figures.drawing import (
    BLUE,
    COLOURS,
    DIVERGING,
    GREY,
    LINES,
    ORANGE,
    colour_bar,
    mollweide,
    shown,
    sky_panel,
    temperatures,
)
from lusee_bayes.report.figures.maps import channel_map, sky_spectrum
from lusee_bayes.results.channel import ChannelResult
from lusee_bayes.results.channel_map import conditioned
from lusee_bayes.runs.plan_run import expected_inference
from lusee_bayes.sampling.datatree import read_datatree
from lusee_bayes.sampling.mode import summary
from lusee_bayes.sky.galaxy import BRIGHT_SOURCES, galaxy_map
from lusee_bayes.systematics.context import Setup

HERE = Path(__file__).parent / "figures"
# measured and modelled skies, which are not part of the repository
DATA = Path(__file__).resolve().parents[2] / "shared" / "data"
GREEN = "#009E73"  # of the same palette as BLUE and ORANGE


def first_map() -> None:
    """Draw the maps of `lusee-bayes map`."""
    made = conditioned(lb.build(lb.load_scenario("first_map")))
    channel_map(made.result(made.channel_data())).savefig(HERE / "maps.png", dpi=110)


def fixed_axis() -> None:
    """Draw and print the errors of a fixed axis, in visibilities and in the map."""
    scenario = lb.load_scenario("fiducial")
    experiment = lb.build(scenario)
    found, data, sky = lb.infer(experiment), experiment.data.data, experiment.setup.sky.modes
    beams, observation = experiment.setup.beams, experiment.setup.observation
    exact = lb.CouplingMatrix.build(beams, Pointing.of(observation, scenario.lmax, order=6))
    sigma = np.sqrt(np.asarray(found.model.noise.diagonal()))
    truth = exact @ sky
    reference = signal_to_noise(found.posterior.mean, sky)
    print("| axis | rms [sigma] | worst [sigma] | first ell with SNR < 1 |")
    print("| --- | --- | --- | --- |")
    lines = {}
    for order, name in enumerate(["fixed at its mean", "wanders, first order", "second order"]):
        coupling = lb.CouplingMatrix.build(
            beams, Pointing.of(observation, scenario.lmax, order=order)
        )
        error = np.abs((coupling @ sky - truth) / sigma)
        model = lb.LinearGaussian(coupling, found.model.prior, found.model.noise)
        snr = signal_to_noise(model.condition(data).posterior.mean, sky)
        lines[name] = snr
        print(
            f"| {name} | {np.sqrt(np.mean(error**2)):.2g} | {error.max():.2g} | {ell_cross(snr)} |"
        )
    figure = Figure(figsize=(6, 4), layout="constrained")
    axes = figure.subplots()
    ell = np.arange(1, len(reference))
    axes.semilogy(ell, reference[1:], color=BLUE, label="wandering axis (exact)")
    axes.semilogy(ell, lines["fixed at its mean"][1:], color=ORANGE, ls="--", label="fixed axis")
    axes.axhline(1.0, color="grey", lw=0.8, ls=":")
    axes.set(xlabel=r"multipole $\ell$", ylabel=r"$\mathrm{SNR}_\ell$", xlim=(1, ell[-1]))
    axes.set_title("The same data, two assumptions about the Moon's axis")
    axes.legend(frameon=False)
    figure.savefig(HERE / "fixed_axis.png", dpi=90)


def instants() -> None:
    """Draw and print what becomes of the map if averages are taken for instants."""
    styles = {
        "windows": ("windows", {"color": BLUE, "marker": "s"}),
        "instants": ("instants in the middle", {"color": ORANGE, "marker": "o"}),
        "starts": ("starts taken for middles", {"color": GREEN, "marker": "^"}),
    }
    figure = Figure(figsize=(10, 4.4), layout="constrained")
    per_direction, per_length = figure.subplots(1, 2)
    # groups of combinations of coefficients, narrow where they are measured best
    edges = np.append(0, np.geomspace(4, 48**2, 20).astype(int))
    for name, (experiment, found) in taken_for(2.0, lmax=47).items():
        label, style = styles[name]
        posterior, data = found.posterior, experiment.data.data
        scale = np.sqrt(posterior.prior.variance())
        # eigenvectors of the covariance in units of the prior: what is known best comes first
        variances, directions = np.linalg.eigh(posterior.covariance() / np.outer(scale, scale))
        error = directions.T @ ((posterior.mean - experiment.setup.sky.modes) / scale)
        rms = np.sqrt(np.add.reduceat(error**2 / variances, edges[:-1]) / np.diff(edges))
        chi2 = _chi2(found.model, data)
        print(name, f"chi2 {chi2:.0f} of {len(data)}", np.round(rms, 1))
        label = f"{label}: $\\chi^2$ {chi2:,.0f} of {len(data):,} data"
        per_direction.loglog((edges[:-1] + edges[1:]) / 2, rms, ms=4, label=label, **style)
    per_direction.set(
        xlabel="combination of coefficients, best measured first",
        ylabel="map - truth [standard deviations, rms]",
        title="Maps of means over 2 h",
        xlim=(2, 48**2),
        ylim=(0.1, 1e5),
    )
    print("| length [h] | taken for | data, rms | largest | map | chi^2 |\n|" + " --- |" * 6)
    lengths_h, rows = (1 / 6, 0.5, 1.0, 2.0, 4.0, 8.0, 12.0, 24.0), {"starts": [], "instants": []}
    for length_h in lengths_h:
        taken = taken_for(length_h, lmax=31)
        truth = taken["windows"][0].setup
        for name, row in rows.items():
            coupling, model = taken[name][0].setup.coupling, taken[name][1].model
            change = np.asarray(truth.coupling @ truth.sky.modes - coupling @ truth.sky.modes)
            squares = change**2 / np.asarray(model.noise.diagonal())
            chi2 = _chi2(model, change)  # the rest is in the map
            row.append((np.sqrt(squares.sum() - chi2), chi2 / np.sqrt(2 * len(change))))
            of_data = np.sqrt([squares.mean(), squares.max()])
            numbers = " | ".join(f"{x:.3g}" for x in (*of_data, *row[-1]))
            print(f"| {length_h:.3g} | {name} | {numbers} |")
    for name, row in rows.items():
        label, style = styles[name]
        for values, ls, what in zip(np.transpose(row), "-:", ("map", r"$\chi^2$"), strict=True):
            per_length.loglog(lengths_h, values, ls, ms=4, label=f"{label}: {what}", **style)
    per_length.set(
        xlabel="length of the samples",
        ylabel="shift [standard deviations]",
        title=r"The map is far off, and $\chi^2$ does not show it",
        ylim=(1e-9, 1e6),
    )
    per_length.minorticks_off()
    per_length.set_xticks(lengths_h, ["10 min", "", "1 h", "2 h", "4 h", "8 h", "", "24 h"])
    for axes in (per_direction, per_length):
        axes.axhline(1.0, color="grey", lw=0.8)
        axes.legend(frameon=False, fontsize=8)
    figure.savefig(HERE / "instants.png", dpi=90)


def _chi2(model: lb.LinearGaussian, data: np.ndarray) -> float:
    """Of data under a model without a mean, any sky of the prior being possible."""
    found = model.condition(data).posterior
    return float(model.chi2(found.mean, data)) + float(found.prior_chi2())


def taken_for(length_h: float, lmax: int) -> dict[str, tuple[Experiment, Inference]]:
    """Map means over windows as such, as instants in their middles, and shifted by a half.

    Parameters
    ----------
    length_h : float
        Of the windows, in hours.
    lmax : int
    """
    plain = [f"lmax={lmax}", f"observation.step_s={3600 * length_h}", "observation.window=mean"]
    scenario = lb.load_scenario("fiducial", plain)
    data = lb.build(scenario).data
    there = data.observation
    observations = {
        "windows": there,
        "instants": replace(there, windows=None),
        "starts": replace(there, times=there.times - length_h / 2 * u.hour),
    }
    taken = {}
    for name, observation in observations.items():
        experiment = lb.build(scenario, replace(data, observation=observation))
        taken[name] = experiment, lb.infer(experiment)
    return taken


def embedded_sky() -> None:
    """Draw the embedded Galaxy at 1, 3 and 10 MHz, beside ULSA's maps if they are there."""
    ulsa = DATA / "ulsa"
    figure = Figure(figsize=(10, 8.5), layout="constrained")
    for row, frequency in enumerate((1.0, 3.0, 10.0)):
        ours = galaxy_map(frequency)
        pairs = [("embedded", ours)]
        if ulsa.is_dir():
            path = ulsa / f"exp{frequency}MHz_sky_map_with_absorption.hdf5"
            sky = lb.sky_from_file(path, frequency, 95)
            pairs.append(("ULSA (Cong et al. 2021)", modes_to_map(sky.modes, 64)))
        norm = LogNorm(*np.percentile(ours, [1, 99.5]))
        for column, (name, pixels) in enumerate(pairs):
            axes = figure.add_subplot(3, 2, 2 * row + column + 1)
            image = mollweide(axes, pixels, norm=norm)
            axes.set_title(f"{name}, {frequency:g} MHz")
            colour_bar(figure, image, axes, label="K", shrink=0.8)
    figure.savefig(HERE / "embedded_sky.png", dpi=80)
    if ulsa.is_dir():
        print("| MHz | mean / ULSA's | C_ell / ULSA's, ell = 1..30 |\n| --- | --- | --- |")
        for frequency in (1.0, 3.0, 10.0):
            path = ulsa / f"exp{frequency}MHz_sky_map_with_absorption.hdf5"
            theirs = lb.sky_from_file(path, frequency).modes
            ours = lb.galaxy_sky(frequency, sources=()).modes
            ratio = (power_spectrum(ours) / power_spectrum(theirs))[1:31]
            print(
                f"| {frequency:g} | {float(ours[0] / theirs[0]):.3f} "
                f"| {ratio.min():.2f} to {ratio.max():.2f} |"
            )


def point_sources() -> None:
    """Draw maps of data with the catalogue's sources, fitted separately or left to the map."""
    listed = ", ".join(f"{{name: {source.name}}}" for source in BRIGHT_SOURCES)
    figure = Figure(figsize=(9, 7.5), layout="constrained")
    top, bottom = figure.subfigures(2, 1, height_ratios=(1.1, 1))
    residuals, lines = {}, {}
    for treatment in ("marginalised", "ignored"):
        overrides = [f"sources.list=[{listed}]", f"sources.treatment={treatment}"]
        experiment = lb.build(lb.load_scenario("fiducial", overrides))
        made = conditioned(experiment)
        channel = made.result(made.channel_data())
        mean, truth = channel.mean, channel.truth
        lines[treatment] = signal_to_noise(mean, truth)
        residuals[treatment] = shown(mean - truth, 64)
        if channel.fluxes is not None:
            print(channel.fluxes.to_string(float_format="{:.4g}".format))
    # the sky with its sources up to lmax, which the second map should show
    with_sources, fluxes = truth, true_values(experiment.setup)
    for source in BRIGHT_SOURCES:
        flux = fluxes[f"flux_{source.name.replace(' ', '_')}"]
        unit = source.modes(25.0, 47) / source.kelvin_steradian(25.0)
        with_sources = with_sources + flux * unit
    lines["ignored, truth with sources"] = signal_to_noise(mean, with_sources)
    largest = np.percentile(np.abs(residuals["marginalised"]), 99)
    for column, (treatment, title) in enumerate(
        [("marginalised", "fitted separately"), ("ignored", "left to the map")]
    ):
        axes = top.add_subplot(1, 2, column + 1)
        image = mollweide(
            axes, residuals[treatment], norm=Normalize(-largest, largest), cmap="RdBu_r"
        )
        axes.set_title(f"sources {title}")
        top.colorbar(
            image,
            ax=axes,
            orientation="horizontal",
            shrink=0.7,
            label="posterior mean - diffuse sky [K]",
            ticks=np.round([-0.9 * largest, 0, 0.9 * largest], -3),
        )
    axes = bottom.subplots()
    ell = np.arange(1, 48)
    for name, label, style in [
        ("marginalised", "sources fitted", {"color": BLUE}),
        ("ignored", "left to the map, against the diffuse sky", {"color": ORANGE, "ls": "--"}),
        (
            "ignored, truth with sources",
            "left to the map, against the sky with sources",
            {"color": "grey", "ls": "-."},
        ),
    ]:
        axes.semilogy(ell, lines[name][1:], label=label, **style)
        print(name, ell_cross(lines[name]), lines[name][[5, 10, 15, 20]])
    axes.axhline(1.0, color="grey", lw=0.8, ls=":")
    axes.set(xlabel=r"multipole $\ell$", ylabel=r"$\mathrm{SNR}_\ell$", xlim=(1, 47))
    axes.legend(frameon=False)
    figure.savefig(HERE / "sources.png", dpi=90)


def regolith() -> None:
    """Draw the posterior of ground, tilt and noise level, and the error of a wrong ground."""
    experiment = lb.build(lb.load_scenario("regolith"))
    setup, data = experiment.setup, experiment.data
    true = true_values(setup)
    tree = read_datatree(Path("output/regolith/samples.nc"))
    draws = {name: tree["posterior"][name].values for name in true}
    table = summary(draws)
    print(table)
    for name, value in true.items():
        low, high = np.quantile(draws[name], [0.025, 0.975])
        print(f"| {name} | {value:.6g} | {low:.6g} to {high:.6g} | {low < value < high} |")
    base, sky = base_model(setup), setup.sky.modes
    ground = {name: true[name] for name in ("surface_permittivity", "zenith_angle_deg")}
    wrong = ground | {"surface_permittivity": setup.scenario.beam.surface_permittivity}

    def fixed(values):
        model = lb.LinearGaussian(setup.instrument.coupling(values), base.prior, base.noise)
        return signal_to_noise(model.condition(data.data).posterior.mean, sky)

    mean = tree["posterior"]["sky"].values.mean((0, 1))
    lines = {
        "inferred with the map": (signal_to_noise(mean, sky), {"color": BLUE}),
        "fixed at the truth": (fixed(ground), {"color": "grey", "ls": ":", "lw": 2.5}),
        f"permittivity fixed at {wrong['surface_permittivity']:g}": (
            fixed(wrong),
            {"color": ORANGE, "ls": "--"},
        ),
    }
    figure = Figure(figsize=(9.5, 6), layout="constrained")
    top, bottom = figure.subfigures(2, 1, height_ratios=(1, 1.3))
    labels = {
        "noise_level": "noise variance / radiometer's",
        "surface_permittivity": "surface permittivity",
        "zenith_angle_deg": "angle of the arms from the zenith [deg]",
    }
    for axes, (name, label) in zip(top.subplots(1, 3), labels.items(), strict=True):
        axes.hist(draws[name].ravel(), bins=25, color=BLUE, alpha=0.7)
        axes.axvline(true[name], color="black", lw=1.2)
        axes.set(xlabel=label, yticks=[])
        axes.locator_params(axis="x", nbins=4)
        axes.ticklabel_format(axis="x", useOffset=False)
    top.suptitle("posterior; black: the truth")
    axes = bottom.subplots()
    ell = np.arange(1, len(mean) ** 0.5)
    for label, (snr, style) in lines.items():
        axes.semilogy(ell, snr[1:], label=label, **style)
        print(label, ell_cross(snr), snr[[1, 5, 10, 15, 20]])
    axes.axhline(1.0, color="grey", lw=0.8, ls=":")
    axes.set(xlabel=r"multipole $\ell$", ylabel=r"$\mathrm{SNR}_\ell$", xlim=(1, ell[-1]))
    axes.legend(frameon=False)
    figure.savefig(HERE / "regolith.png", dpi=90)


# of the gallery: a sky's file and frequency in MHz, and priors
ULSA_SKY = DATA / "ulsa" / "exp10.0MHz_sky_map_with_absorption.hdf5", 10.0
PAPER = "prior={model: isotropic, spectrum: sky}"
LEARNED = "prior={model: local_scales}"
# colour bars beside maps
BAR = {"shrink": 0.8, "pad": 0.03}


def _save(figure: Figure, name: str, dpi: int = 100) -> None:
    """Write a figure with 256 colours, a third of the size."""
    file = BytesIO()
    figure.savefig(file, dpi=dpi)
    image = Image.open(file).convert("RGB").quantize(256, kmeans=3, dither=Image.Dither.NONE)
    image.save(HERE / f"{name}.png", optimize=True)


def _mapped(*overrides: str, scenario: str = "fiducial") -> ChannelResult:
    """The map of a scenario, one channel, with its known truth."""
    made = conditioned(lb.build(lb.load_scenario(scenario, overrides)))
    return made.result(made.channel_data())


def _sky_of(path: Path, frequency_mhz: float) -> list[str]:
    """Overrides for a sky of a file; for the embedded one where that is not there."""
    sky = f"sky={{model: file, file: {path}, file_frequency_mhz: {frequency_mhz}}}"
    return [f"frequency_mhz={frequency_mhz}", *([sky] if path.exists() else [])]


def gallery_priors() -> None:
    """Draw two maps of one data set: under the default prior, and under the paper's."""
    sky = ["lmax=24", *_sky_of(*ULSA_SKY)]
    maps = {"default prior": _mapped(*sky, LEARNED), "paper's prior": _mapped(*sky, PAPER)}
    true = maps["default prior"].truth
    truth, altitude = shown(true, 64), maps["default prior"].highest_altitude
    kelvin, percents, z = temperatures(truth, 0.05), Normalize(-5, 5), np.linspace(-4, 4, 41)
    figure = Figure(figsize=(9.6, 6.4), layout="constrained")
    panels, style = figure.subplots(3, 3), {"highest_altitude": altitude}
    images = [mollweide(panels[0, 0], truth, norm=kelvin, **style), None, None]
    panels[0, 0].set_title("true sky (ULSA, 10 MHz)")
    spectra, histogram = panels[1:, 0]
    ell = np.arange(1, 25)
    spectra.semilogy(ell, power_spectrum(true)[1:], color="black", label="sky")
    for column, (name, channel), colour in zip((1, 2), maps.items(), (BLUE, ORANGE), strict=True):
        error = channel.mean - true
        percent = 100.0 * shown(error, 64) / truth.mean()
        pull = channel.maps()["residual"] / channel.pixel_std
        mean, off, off_z = panels[:, column]
        mollweide(mean, shown(channel.mean, 64), norm=kelvin, **style)
        images[1] = mollweide(off, percent, norm=percents, cmap=DIVERGING, **style)
        images[2] = mollweide(off_z, pull, norm=Normalize(-4, 4), cmap=DIVERGING, **style)
        mean.set_title(f"map, {name}")
        off.set_title(f"error: rms {percent.std():.1f} %")
        off_z.set_title(f"error / error bar: rms {np.sqrt((pull**2).mean()):.2f}")
        spectra.semilogy(ell, power_spectrum(error)[1:], color=colour, label=f"error, {name}")
        histogram.hist(pull, z, density=True, color=colour, alpha=0.6)
        print(name, f"ln evidence {channel.log_evidence:.0f}, {channel.judged.level}")
    spectra.set(
        title=r"$C_\ell$ [K$^2$] of sky and error", xlim=(1, 24), xlabel=r"multipole $\ell$"
    )
    spectra.legend(frameon=False, fontsize=8, loc=(0.2, 0.62))
    spectra.set_ylim(None, 5e11)
    spectra.yaxis.minorticks_off()
    histogram.plot(z, norm.pdf(z), "k", lw=1.2)
    histogram.set(title="error / error bar (black: ideal)", yticks=[], xlim=(-4, 4))
    for row, label in enumerate(("K", "% of the mean sky", "error bars")):
        beside = list(panels[row, min(row, 1) :])
        colour_bar(figure, images[row], beside, label=label, extend="both", shrink=0.85)
    _save(figure, "gallery_priors", dpi=125)


def gallery_error_bars() -> None:
    """Draw how many pixels of given skies their error bars contain, by latitude."""
    files = {f"GSM 2008, {f} MHz": (f"surveys/gsm2008_{f}MHz.fits", f) for f in (25, 40)}
    for f in (10, 3):
        files[f"ULSA, {f} MHz"] = f"ulsa/exp{f}.0MHz_sky_map_with_absorption.hdf5", f
    skies = {name: _sky_of(DATA / path, float(f)) for name, (path, f) in files.items()}
    skies |= {f"embedded, 25 MHz, seed {k}": [f"sky.seed={k}"] for k in (2, 3)}
    figure = Figure(figsize=(9.6, 4.4), layout="constrained")
    panels = figure.subplots(1, 3, sharey=True)
    level = np.linspace(0.02, 0.995, 60)
    for number, (name, sky) in enumerate(skies.items()):
        for prior in (LEARNED, PAPER):
            channel = _mapped("lmax=24", *sky, prior)
            pull = np.abs(channel.maps()["residual"]) / channel.pixel_std
            parts = zip(panels, latitudes(channel.nside).items(), strict=False)
            style = {"color": COLOURS[number], "lw": 1.8, "label": name}
            if prior == PAPER:
                style = {"color": GREY, "lw": 0.9, "ls": "--"}
            for axes, (where, inside) in parts:
                held = (pull[inside, None] < norm.ppf(0.5 + 0.5 * level)).mean(0)
                axes.plot(100 * level, 100 * held, **style)
                axes.set_title(where.replace("deg", "degrees"))
            shares = [f"{part.held[1]:.0%}, {part.held[3]:.0%}" for part in channel.coverage]
            print(f"{name}, {prior}: within 68 and 95 %: {'; '.join(shares)}; {pull.max():.1f}")
    for axes in panels:
        axes.plot([0, 100], [0, 100], "k", lw=0.8)
        axes.set(xlim=(0, 100), ylim=(0, 100), xlabel="probability of the interval [%]")
        axes.set_box_aspect(1)
    panels[0].set_ylabel("pixels whose truth is in it [%]")
    panels[0].plot([], [], color=GREY, lw=0.9, ls="--", label="paper's prior, same skies")
    handles = panels[0].get_legend_handles_labels()
    figure.legend(*handles, loc="outside lower center", ncols=3, frameon=False)
    _save(figure, "gallery_error_bars", dpi=125)


# half a per cent of gain drifts, 5 % of the ground, 0.3 degrees, 20 s, 0.2 degrees, 10 % of 20 kK
EVERYTHING = (
    "noise={gain: {sigma: 0.005}, pointing: {clock_s: 20.0, turntable_deg: 0.2}, "
    "receiver: {power_k: 2.0e4, relative_std: 0.1}, beam: {parameters: {surface_permittivity: "
    "0.185, deep_permittivity: 0.3, zenith_angle_deg: 0.3, length_m: 0.01}}}"
)
# how unknowns are called in figures
CALLED = {
    "surface_permittivity": "permittivity, surface",
    "deep_permittivity": "permittivity, below",
    "zenith_angle_deg": "angle of the arms",
    "length_m": "length of the arms",
    "clock_s": "clock",
    "turntable_0_deg": "turntable, 1st angle",
    "turntable_1_deg": "turntable, 2nd angle",
} | {f"receiver_{k}_k": f"noise of receiver {k}" for k in range(4)}


def gallery_everything() -> None:
    """Draw a map whose instrument is found with it, and how well each unknown is known then."""
    runs = "[{cycles: 0.5}, {cycles: 0.5, turntable_deg: 30.0}]"
    observation = f"observation={{step_s: 14400, runs: {runs}}}"
    sky = _sky_of(DATA / "surveys" / "gsm2008_25MHz.fits", 25.0)
    channel = _mapped("lmax=16", *sky, observation, EVERYTHING, LEARNED)
    truth, mean = (shown(modes, 64) for modes in (channel.truth, channel.mean))
    table, altitude = channel.theta.corner, channel.highest_altitude
    figure = Figure(figsize=(9.6, 5.6), layout="constrained")
    maps, unknowns = figure.subfigures(1, 2, width_ratios=(1, 1.15))
    top, bottom = maps.subplots(2, 1)
    sky_panel(top, "map of GSM 2008, 25 MHz", mean, temperatures(truth, 0.05), altitude=altitude)
    percent = 100.0 * (mean - truth) / truth.mean()
    span = Normalize(-3, 3)
    unit = "% of the mean sky"
    sky_panel(bottom, "map - truth", percent, span, DIVERGING, unit, altitude=altitude)
    widths, pulls = unknowns.subplots(1, 2, sharey=True, width_ratios=(1.5, 1))
    rows, ratio = np.arange(len(table)), (table["prior_std"] / table["std"]).to_numpy()
    widths.barh(rows, ratio, color=BLUE, alpha=0.75)
    for row, value in zip(rows, ratio, strict=True):
        widths.text(1.15 * value, row, f"{value:,.0f}", va="center", fontsize=9)
    widths.set(xscale="log", xlim=(1, 20 * ratio.max()), xlabel="prior / posterior width")
    widths.set_title("better known by")
    pulls.set_title("and right")
    widths.set_yticks(rows, [CALLED.get(name, name) for name in table["unknown"]])
    widths.invert_yaxis()
    widths.xaxis.minorticks_off()
    pull = (table["value"] - table["true"]) / table["std"]
    pulls.errorbar(pull, rows, xerr=1.0, fmt="o", color=BLUE, ms=5)
    pulls.axvline(0.0, color=ORANGE, lw=1.5)
    pulls.set(xlim=(-3.5, 3.5), xticks=(-2, 0, 2), xlabel="error / error bar")
    z = channel.maps()["residual"] / channel.pixel_std
    print(table[["unknown", "prior_std", "std"]].assign(ratio=ratio, pull=pull))
    print(channel.judged.verdict, f"rms pull {np.sqrt((z**2).mean()):.2f}, {percent.std():.2f} %")
    _save(figure, "gallery_everything", dpi=125)


def gallery_cube() -> None:
    """Draw maps from 5 to 45 MHz, and spectra of some directions with their error bars."""
    mhz = (5, 7, 10, 14, 19, 25, 33, 45)
    overrides = ["lmax=16", f"frequencies_mhz={list(mhz)}"]
    with TemporaryDirectory() as folder:
        cube = lb.run_map(lb.load_scenario("first_map", overrides), Path(folder) / "cube").result
    print(cube.verdict())
    figure = Figure(figsize=(9.6, 6.4), layout="constrained")
    maps, below = figure.subfigures(2, 1, height_ratios=(1, 1.25))
    for axes, number in zip(maps.subplots(2, 3).flat, (0, 2, 3, 5, 6, 7), strict=True):
        channel = cube.channels[number]
        pixels = shown(channel.mean, 64)
        scale = LogNorm(pixels.mean() / 3, 4 * pixels.mean())
        image = mollweide(axes, pixels, norm=scale, highest_altitude=channel.highest_altitude)
        level = float(f"{pixels.mean():.3g}")
        axes.set_title(f"{mhz[number]} MHz: mean {level:,.0f} K")
    bar = maps.colorbar(image, ax=maps.axes, shrink=0.8, extend="both", label="of the mean sky")
    mean = pixels.mean()
    bar.set_ticks([mean / 3, mean, 4 * mean], labels=["1/3", "1", "4"])
    bar.set_ticks([], minor=True)
    spectra, errors = below.subplots(1, 2, width_ratios=(1.2, 1))
    f = cube.frequencies_mhz
    flat = (f / 10.0) ** 2.5
    for (name, seen), colour in zip(cube.landmarks().items(), COLOURS, strict=False):
        scaled = [seen[key] * flat / 1e3 for key in ("mean", "std", "truth")]
        spectra.errorbar(f, *scaled[:2], fmt="o", ms=4, color=colour, label=name)
        spectra.plot(f, scaled[2], color=colour, lw=1.0)
        errors.loglog(f, 100.0 * seen["std"] / seen["mean"], "o-", ms=4, color=colour)
        print(name, np.round((seen["mean"] - seen["truth"]) / seen["std"], 1))
    spectra.set(yscale="log", title=r"T $\times$ (f / 10 MHz)$^{2.5}$ [kK], lines: truth")
    spectra.set_yticks([200, 500, 1000, 2000], ["200", "500", "1,000", "2,000"])
    errors.set(title="error bars [%]")
    errors.set_yticks([0.2, 0.5, 1, 2], ["0.2", "0.5", "1", "2"])
    for axes in (spectra, errors):
        axes.set(xscale="log", xlabel="frequency [MHz]")
        axes.set_xticks([5, 10, 20, 40], ["5", "10", "20", "40"])
        axes.minorticks_off()
    below.legend(
        *spectra.get_legend_handles_labels(), loc="outside lower center", ncols=4, frameon=False
    )
    _save(figure, "gallery_cube", dpi=125)


def gallery_turntable() -> None:
    """Draw what turns of the table reveal of the antennas, and what they add to the map."""
    names = {
        "zenith_angle_deg": "angle of the arms",
        "height_m": "height above ground",
        "surface_permittivity": "surface permittivity",
        "length_m": "length of the arms",
    }
    figure = Figure(figsize=(9.6, 4.2), layout="constrained")
    left, right = figure.subplots(1, 2)

    def planned(*runs: tuple[float, float]) -> tuple[Setup, Inference]:
        said = ", ".join(f"{{cycles: {n}, turntable_deg: {angle}}}" for n, angle in runs)
        overrides = ["lmax=24", f"observation.runs=[{said}]"]
        setup = set_up(lb.load_scenario("fiducial", overrides))
        return setup, expected_inference(setup)

    angles, bias = (0, 3, 7.5, 15, 22.5, 30, 37.5, 45, 52.5, 60, 67.5, 75, 82.5, 87, 90), []
    for angle in angles:
        setup, found = planned((0.5, 0.0), (0.5, angle))
        spots = blind_spots(setup, found, np.asarray(setup.sky.modes))
        told = {spot.name: spot.unnoticed for spot in spots}
        bias.append([told[name][1] for name in names])
        print(angle, {name: f"{told[name][0]:.2g} %, {told[name][1]:.3g}" for name in names})
    for k, (name, values) in enumerate(zip(names.values(), np.transpose(bias), strict=True)):
        style = {"color": COLOURS[k], "ls": LINES[k % len(LINES)], "marker": "o", "ms": 4}
        left.plot(angles, values, label=name, **style)
    left.set(title="map error that nobody notices [error bars]", ylim=(0, None))
    left.set(xlabel="turn after half a cycle [degrees]", xticks=range(0, 91, 15))
    left.legend(frameon=False, title="antennas off by just too little to see in chi²")
    cycles = range(1, 6)
    ways = {"30 degrees in every cycle": 30.0, "90 degrees in every cycle": 90.0, "never": 0.0}
    for k, (name, turn) in enumerate(ways.items()):
        found = [planned(*((1.0, turn * j) for j in range(n)))[1] for n in cycles]
        bits = [float(one.posterior.information_bits()) for one in found]
        print(name, np.round(bits))
        style = {"color": COLOURS[k], "ls": LINES[k], "marker": "os^"[k], "ms": 5}
        right.plot(cycles, bits, label=name, **style)
    right.set(title="information about the sky [bits]", xlabel="lunar cycles", xticks=cycles)
    right.legend(frameon=False, title="the table turns by")
    _save(figure, "gallery_turntable", dpi=125)


# two weeks of ten-minute spectra with everything that can be flagged
SPECTRA = (
    "lmax=16",
    "observation={window: mean, step_s: 600, average_s: 14400, runs: [{cycles: 0.5}]}",
    "noise.radiometer={form: exact, temperature: measured}",
    "noise.receiver={power_k: 300, relative_std: 0.3}",
    "noise.beam={parameters: {surface_permittivity: 0.04, zenith_angle_deg: 0.1}}",
    "flight={bin_origin: centre, per_kelvin_v2_hz: 5.0e-23, simulated: {session_h: 170, "
    "saturated_share: 0.01, absent_share: 0.005, comb_share: 0.04, tones_mhz: [25.2], tone_share: "
    "0.05, burst_every_h: 12, burst_s: 1200, burst_factor: 100, switch_h: 200}}",
)


def gallery_flight() -> None:
    """Draw the counts of a simulated session, what was flagged, and the map of two sessions."""
    channels = slice(980, 1021)
    with TemporaryDirectory() as folder:
        files = lb.run_simulate_flight(lb.load_scenario("first_map", SPECTRA), f"{folder}/flight")
        with h5py.File(files.sessions[0]) as session:
            counts = session["spectra/data"][:, 0, channels]
        result = lb.run_map(files.scenario, f"{folder}/map", data=files.sessions, truth=True).result
    reduced, channel, n = result.reduced, result.channel, len(counts)
    print(result.verdict(), reduced.flag_line(0))
    counts /= np.nanmedian(counts, axis=0)
    lines = 1e3 * (counts / np.median(counts, axis=1, keepdims=True) - 1.0)
    figure = Figure(figsize=(9.6, 7.2), layout="constrained")
    session, below = figure.subfigures(2, 1, height_ratios=(1.15, 1))
    top, flags = session.subplots(2, 1, sharex=True, height_ratios=(2.2, 1))
    edges = (0, n / 144, 0.025 * channels.start, 0.025 * channels.stop)
    style = {"cmap": DIVERGING, "vmin": -2, "vmax": 2, "aspect": "auto", "origin": "lower"}
    image = top.imshow(lines.T, extent=edges, interpolation="nearest", **style)
    session.colorbar(image, ax=top, label="counts, deviation [0.1 %]", pad=0.01)
    top.set(ylabel="frequency [MHz]", title="one of 16 products of a session: tone and comb")
    reasons, days = reduced.reason[0, :n], np.arange(n) / 144
    rows = {name: reasons == REASONS.index(name) for name in ("saturated", "burst")}
    rows |= {"product missing": reasons == PRODUCT, "channels": reduced.lines[0, :n] > 0}
    rows["channels"] &= ~rows["saturated"]
    for row, where in enumerate(rows.values()):
        flags.plot(days[where], np.full(where.sum(), row), "|", color=ORANGE, ms=9)
    flags.set_yticks(range(len(rows)), rows)
    flags.set(ylim=(len(rows) - 0.5, -0.5), xlabel="days", title="flagged")
    left, right = below.subplots(1, 2)
    mean, altitude = shown(channel.mean, 64), channel.highest_altitude
    percent = 100.0 * (mean - shown(channel.truth, 64)) / mean.mean()
    sky_panel(left, "map of two sessions", mean, temperatures(mean, 0.05), altitude=altitude, **BAR)
    span, unit = Normalize(-5, 5), "% of the mean sky"
    sky_panel(right, "map - truth", percent, span, DIVERGING, unit, altitude=altitude, **BAR)
    seen = channel.maps()["residual"][altitude > 0]
    print(f"rms error where the sky rises: {100 * seen.std() / mean.mean():.2f} %")
    _save(figure, "gallery_flight", dpi=125)


# ten channels of the default scenario, with gains and receivers unknown, too
TEN_CHANNELS = (
    "frequencies_mhz=[6, 8, 10, 13, 17, 21, 25, 30, 36, 42]",
    "noise.receiver={power_k: 20000, slope: -2, relative_std: 0.1, smooth_octaves: 1}",
    "noise.gain={sigma: 0.005, correlation_h: 10}",
)


def spectrum() -> None:
    """Draw the spectrum of the sky, and its errors by source."""
    with TemporaryDirectory() as folder:
        result = lb.run_map(lb.load_scenario("first_map", TEN_CHANNELS), f"{folder}/map").result
    for name, figure in sky_spectrum(result).items():
        figure.savefig(HERE / f"spectrum_{name}.png", dpi=90)
    temperatures = result.sky_spectrum()
    for region in temperatures.regions:
        print(region, temperatures.chi2(region).words())


FIGURES = (
    first_map,
    point_sources,
    embedded_sky,
    fixed_axis,
    instants,
    regolith,
    gallery_priors,
    gallery_error_bars,
    gallery_everything,
    gallery_cube,
    gallery_flight,
    gallery_turntable,
    spectrum,
)

if __name__ == "__main__":
    HERE.mkdir(exist_ok=True)
    named = {draw.__name__: draw for draw in FIGURES}
    if not Path("output/regolith").is_dir():
        del named["regolith"]
    for name in sys.argv[1:] or named:
        named[name]()
