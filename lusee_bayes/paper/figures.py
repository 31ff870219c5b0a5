"""Figures with the content of the paper's figures 2 to 9, drawn from the computed cases."""

import numpy as np
import xarray as xr
from jaxtyping import Float
from matplotlib import colormaps, colors
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from lusee_bayes.core import harmonics, lazy, reading
from lusee_bayes.instrument.beams.fields import HemisphereGrid
from lusee_bayes.paper.cases import TABLE
from lusee_bayes.paper.claims import FREQUENCIES, SHOWN_FREQUENCIES, Cases, frequency_case
from lusee_bayes.report.figures import drawing

# colours of the groups of scenarios, and the cases whose maps are shown
SHOWN = reading.table_beside(__file__)
LINES = ("-", "--", ":")


def beam_panels(cases: Cases) -> Figure:
    """Figure 2: an auto and two crosses at five frequencies, each relative to its peak."""
    figure, panels = drawing.framed((13, 8), 3, len(SHOWN_FREQUENCIES))
    for column, frequency in enumerate(SHOWN_FREQUENCIES):
        beam = cases[frequency_case(frequency)]["beam"]
        grid = HemisphereGrid.gauss_legendre(beam.sizes["theta"], beam.sizes["phi"])
        for row, name in enumerate(beam["pattern"].values):
            image = drawing.orthographic(panels[row, column], grid, np.abs(beam.values[row]))
            panels[0, column].set_title(f"{frequency} MHz")
            panels[row, 0].set_ylabel(str(name))
    figure.colorbar(image, ax=panels, label="beam / its peak", shrink=0.6)
    figure.suptitle("Beams of the antenna that points North (0): zenith at the centre, North up")
    return figure


def data_by_product(cases: Cases) -> Figure:
    """Figure 3: the products at 25 MHz side by side, time running within each."""
    data = cases["fiducial"]["data"]
    figure, axes = drawing.framed((11, 4))
    drawing.side_by_side(axes, data.values, data["product"].values.tolist())
    n_products, n_times = data.shape
    axes.set_title(f"Data vector at 25 MHz: {n_products} products, {n_times} samples each")
    return figure


def frequency_maps(cases: Cases) -> Figure:
    """Figure 4: truth, posterior mean and relative difference, at five frequencies."""
    figure, panels = drawing.framed((20, 6.5), 3, len(SHOWN_FREQUENCIES))
    for column, frequency in enumerate(SHOWN_FREQUENCIES):
        case = cases[frequency_case(frequency)]
        mean, truth = (drawn(case, name) for name in ("mean", "truth"))
        percent = 100.0 * (mean - truth) / truth.mean()
        limit = float(np.percentile(np.abs(percent), 99.0))
        norm = drawing.temperatures(truth)
        seen, signed = case["highest_altitude"].values, colors.Normalize(-limit, limit)
        rows = [
            ("truth", truth, norm, "inferno", None),
            ("posterior mean", mean, norm, "inferno", seen),
            ("difference", percent, signed, drawing.DIVERGING, seen),
        ]
        for row, (name, pixels, scale, cmap, altitude) in enumerate(rows):
            unit = "K" if row < 2 else "% of the mean sky"
            given = f"{frequency} MHz, {name}", pixels, scale, cmap, unit
            drawing.sky_panel(panels[row, column], *given, altitude=altitude, shrink=0.7, pad=0.02)
    figure.suptitle(f"Galactic coordinates, longitude grows to the left; {_how_drawn(case)}")
    return figure


def _how_drawn(case: xr.Dataset) -> str:
    """Note on the lines and the resolution in a figure of maps."""
    width = harmonics.taper_fwhm_deg(harmonics.lmax_of(case.sizes["mode"]))
    return f"dashed: never observed; drawn through a beam of {width:.1f}° (FWHM)"


def drawn(case: xr.Dataset, name: str) -> Float[np.ndarray, " pixels"]:
    """Map of ``mean`` or ``truth``, smoothed with the taper's beam as in reports."""
    return drawing.shown(case[f"{name}_modes"].values, lazy.healpy.npix2nside(case.sizes["pixel"]))


def by_frequency(cases: Cases, metric: str) -> Figure:
    """Figures 5, 6: rho_ell or SNR_ell, one curve per frequency, from dark (low) to light."""
    figure, axes = drawing.framed((8, 4.8))
    shades = colormaps["viridis"](np.linspace(0.0, 0.92, len(FREQUENCIES)))
    for k, (frequency, shade) in enumerate(zip(FREQUENCIES, shades, strict=True)):
        curve, line = cases[frequency_case(frequency)][metric], LINES[k % 2]
        axes.plot(curve["ell"][1:], curve[1:], color=shade, ls=line, label=f"{frequency} MHz")
    dress(axes, metric, int(curve["ell"][-1]))
    axes.legend(frameon=False, loc="center left", bbox_to_anchor=(1.0, 0.5))
    axes.set_title("The fiducial experiment: one lunar cycle, turntable at rest")
    return figure


def dress(axes: Axes, metric: str, lmax: int) -> None:
    """Add labels, limits and the levels discussed in the text."""
    axes.set(xlabel=r"multipole $\ell$", xlim=(1, lmax))
    if metric == "rho":
        axes.set(ylabel=r"correlation with the truth $\rho_\ell$", ylim=(-0.35, 1.05))
        levels = (0.0, 0.5, 0.9)
    else:
        axes.set(ylabel=r"$\mathrm{SNR}_\ell$", yscale="log")
        levels = (1.0,)
    for level in levels:
        axes.axhline(level, color=drawing.GREY, lw=0.7, ls=":", zorder=0)


def by_scenario(cases: Cases, metric: str) -> Figure:
    """Figures 7, 8: rho_ell or SNR_ell at 25 MHz, a panel for each group of scenarios.

    The fiducial scenario is black in all panels.
    """
    figure, panels = drawing.framed((12, 8), 2, 2, sharex=True, sharey=True)
    for axes, (title, colour) in zip(panels.flat, SHOWN["colours"].items(), strict=True):
        curve = cases["fiducial"][metric]
        axes.plot(curve["ell"][1:], curve[1:], color="black", lw=1.6, label="fiducial")
        members = {name: case for name, case in TABLE.items() if case.get("group") == title}
        for line, (name, case) in zip(LINES, members.items(), strict=True):
            style = {"color": colour, "ls": line, "lw": 1.6, "label": case["label"]}
            axes.plot(cases[name]["ell"][1:], cases[name][metric][1:], **style)
        dress(axes, metric, int(curve["ell"][-1]))
        axes.label_outer()
        axes.set_title(title)
        axes.legend(frameon=False, fontsize=9, ncols=2, loc="upper center")
    # space above the curves for the legends
    low, high = axes.get_ylim()
    axes.set_ylim(low, 8 * high if metric == "snr" else 1.4)
    if metric == "rho":
        axes.set_yticks([-0.25, 0.0, 0.25, 0.5, 0.75, 1.0])
    figure.suptitle("Scenarios at 25 MHz")
    return figure


def scenario_maps(cases: Cases) -> Figure:
    """Figure 9: the true sky at 25 MHz and the map of every scenario, in the same colours."""
    truth = drawn(cases["fiducial"], "truth")
    norm, shown = drawing.temperatures(truth), [("truth", truth, None)]
    for name in SHOWN["maps"]:
        case = TABLE[name]
        title = f"{case['group']}: {case['label']}" if "group" in case else name
        shown.append((title, drawn(cases[name], "mean"), cases[name]["highest_altitude"].values))
    figure, panels = drawing.framed((13, 11), 4, 3)
    for axes, (title, pixels, altitude) in zip(panels.flat, shown, strict=True):
        image = drawing.mollweide(axes, pixels, norm=norm, highest_altitude=altitude)
        axes.set_title(title, fontsize=11)
    bar = {"location": "bottom", "aspect": 60, "shrink": 0.7, "pad": 0.04}
    drawing.colour_bar(figure, image, figure.axes, label="K", extend="both", **bar)
    figure.suptitle(f"Maps at 25 MHz, Galactic coordinates; {_how_drawn(cases['fiducial'])}")
    return figure


FIGURES = {
    "2_beams": beam_panels,
    "3_data_vector": data_by_product,
    "4_frequency_maps": frequency_maps,
    "5_rho_frequencies": lambda cases: by_frequency(cases, "rho"),
    "6_snr_frequencies": lambda cases: by_frequency(cases, "snr"),
    "7_rho_scenarios": lambda cases: by_scenario(cases, "rho"),
    "8_snr_scenarios": lambda cases: by_scenario(cases, "snr"),
    "9_scenario_maps": scenario_maps,
}
