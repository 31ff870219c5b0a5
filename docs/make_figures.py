"""Draw the documentation's figures and print its tables.

Run from the repository's root: python docs/make_figures.py [ULSA folder]
Those of given skies are benchmarks/skies.py's.
The figure of the regolith needs the draws of
    lusee-bayes sample regolith --draws 320 --warmup 80 -o output/regolith
"""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import astropy.units as u
import numpy as np
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure

import lusee_bayes as lb
from lusee_bayes.core.harmonics import modes_to_map, power_spectrum
from lusee_bayes.experiment.experiment import Experiment
from lusee_bayes.experiment.model import base_model, true_values
from lusee_bayes.experiment.rounds import Inference
from lusee_bayes.instrument.pointing import Pointing
from lusee_bayes.judge.measures import ell_cross, signal_to_noise
from lusee_bayes.report.figures.drawing import BLUE, ORANGE, colour_bar, mollweide, shown
from lusee_bayes.report.figures.maps import channel_map
from lusee_bayes.results.channel_map import conditioned
from lusee_bayes.sampling.datatree import read_datatree
from lusee_bayes.sampling.mode import summary
from lusee_bayes.sky.galaxy import BRIGHT_SOURCES, galaxy_map

HERE = Path(__file__).parent / "figures"
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


def embedded_sky(ulsa: Path | None) -> None:
    """Draw the embedded Galaxy at 1, 3 and 10 MHz, beside ULSA's maps if they are given."""
    figure = Figure(figsize=(10, 8.5), layout="constrained")
    for row, frequency in enumerate((1.0, 3.0, 10.0)):
        ours = galaxy_map(frequency)
        pairs = [("embedded", ours)]
        if ulsa is not None:
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
    if ulsa is not None:
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


def regolith(folder: Path) -> None:
    """Draw the posterior of ground, tilt and noise level, and the error of a wrong ground.

    Parameters
    ----------
    folder : Path
        Written by ``lusee-bayes sample regolith``.
    """
    experiment = lb.build(lb.load_scenario("regolith"))
    setup, data = experiment.setup, experiment.data
    true = true_values(setup)
    tree = read_datatree(folder / "samples.nc")
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


if __name__ == "__main__":
    HERE.mkdir(exist_ok=True)
    if Path("output/regolith").is_dir():
        regolith(Path("output/regolith"))
    first_map()
    point_sources()
    ulsa = Path(sys.argv[1]) if len(sys.argv) > 1 else None
    embedded_sky(ulsa)
    fixed_axis()
    instants()
