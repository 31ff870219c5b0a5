"""Do error bars hold for skies that the prior does not draw? A table, and a figure.

    python benchmarks/skies.py embedded:1 smooth spotty sky.fits survey.fits@45 --set lmax=31

Data of each sky are simulated with the scenario's instrument and noise, and mapped with its prior,
which knows nothing of the sky. Two tests of each sky, both against draws of its posterior: the
share or rms pull, of any band of latitude or group of multipoles, that is furthest from what is
expected; and the largest pull of the whole sky. A second table has the chi^2 per direction of
truth - mean, by how much of the prior's variance the data leave; the share of C_ell within the
draws' central 68 %; and the pull of the mean temperature; with means over all skies. Ends with exit
code 1 if p of either, times the number of all tests, is below 0.01: a run whose error bars are
right fails once in a hundred.
"""

from __future__ import annotations

import argparse
import sys
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from made_skies import SmoothSky, SpottySky
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from rich.console import Console
from rich.table import Table
from scipy.linalg import eigh

import lusee_bayes as lb
from lusee_bayes.core.harmonics import lmax_of, modes_to_map, power_spectrum
from lusee_bayes.experiment.experiment import posterior_draws, under_sky
from lusee_bayes.experiment.model import set_up
from lusee_bayes.experiment.sky_sections import FileSkySection, GalaxySection
from lusee_bayes.judge.coverage import LEVELS, Counts, multipoles
from lusee_bayes.report.figures.drawing import BLUE, DIVERGING, GREY, ORANGE, colour_bar, mollweide
from lusee_bayes.results.channel import ChannelResult
from lusee_bayes.results.channel_map import Conditioned, conditioned
from lusee_bayes.sky.sky_source import SkySource

# each takes a seed
NAMED: dict[str, Callable[[int], SkySource]] = {
    "embedded": lambda seed: GalaxySection(seed=seed, sources=False),
    "embedded+sources": lambda seed: GalaxySection(seed=seed),
    "smooth": SmoothSky,
    "spotty": SpottySky,
}
FALSE_ALARM, TESTS = 0.01, 2
# directions of which at most that share of the prior's variance is left
SUBSPACES = (0.001, 0.01, 0.1, 0.5)
# pulls beyond that have the darkest colours; shares further from their levels are at the rim
WIDEST, FURTHEST = 4.0, 50.0


@dataclass(frozen=True)
class Mapped:
    """The map of a sky, and the pulls of the truth and of draws, by latitude and multipole."""

    name: str
    channel: ChannelResult
    pixels: Counts
    modes: Counts
    # chi^2 per direction of each of SUBSPACES, share of C_ell, pull of the mean temperature
    ratios: tuple[float, ...]
    spectrum: float
    temperature: float

    def p_held(self) -> float:
        """p of the share or rms pull that is furthest from what is expected.

        The share of draws whose furthest is as far, so that it knows how many there are to choose
        from and how they depend on one another.
        """
        values = np.concatenate([one.values[:, :-1] for one in (self.pixels, self.modes)])
        mean, scatter = values[..., 1:].mean(2), values[..., 1:].std(2)
        off = values - mean[..., None]
        # shares of the truth are told from the levels
        off[:, :-1, 0] = values[:, :-1, 0] - LEVELS
        # a part that is known exactly tells nothing
        known = scatter > 0
        return share_above((np.abs(off[known]) / scatter[known][:, None]).max(0))

    def p_largest(self) -> float:
        """p of the largest pull of the whole sky."""
        return share_above(self.pixels.values[-1, -1])

    def holds(self, n_skies: int) -> bool:
        """Whether the error bars are as right as chance allows."""
        return TESTS * n_skies * min(self.p_held(), self.p_largest()) >= FALSE_ALARM


def share_above(values: np.ndarray) -> float:
    """Share of skies whose value is at least the truth's, the truth itself counted among them."""
    return float((values >= values[0]).sum()) / len(values)


def find_sky(text: str) -> tuple[str, SkySource]:
    """NAME or NAME:SEED, a file of any layout that ``sky.file`` takes, or FILE@MHZ to scale it."""
    name, _, seed = text.partition(":")
    if name in NAMED:
        number = int(seed or 1)
        return f"{name}:{number}", NAMED[name](number)
    file, _, frequency = text.partition("@")
    path = Path(file).absolute()
    given = {"file_frequency_mhz": float(frequency)} if frequency else {}
    return path.stem, FileSkySection(file=str(path), **given)


def judged(name: str, made: Conditioned, n_draws: int) -> Mapped:
    """Compare a map with its truth and with draws of its posterior."""
    channel = made.result(made.channel_data())
    error = channel.truth - channel.mean
    drawn = posterior_draws(made.experiment, made.posterior, lambda: made.information, n_draws)
    deviations = drawn - channel.mean
    pixels = Counts.of_pixels(channel.pixel_std, error, deviations)
    # exactly known modes have a pull of zero
    pulls = np.stack([error, *deviations]) / np.where(channel.std > 0, channel.std, np.inf)
    modes = Counts.of(multipoles(lmax_of(len(error))), [pulls])
    left, directions = eigh(made.covariance, made.posterior.prior.covariance())
    chi2 = (directions.T @ error) ** 2 / left
    ratios = tuple(float(chi2[left < share].mean()) for share in SUBSPACES)
    below = (power_spectrum(drawn) < power_spectrum(channel.truth)).mean(0)
    spectrum = float((np.abs(below[1:] - 0.5) < 0.34).mean())
    return Mapped(name, channel, pixels, modes, ratios, spectrum, float(error[0] / channel.std[0]))


def summed_up(mapped: list[Mapped]) -> Table:
    """What is known best, the spectra and the mean temperatures, and their means."""
    names = (*(f"< {share}" for share in SUBSPACES), "C_ell in 68 %", "z of the mean T")
    table = Table("sky", *names, title="chi^2 per direction with so much of the prior's variance")
    rows = np.array([(*sky.ratios, sky.spectrum, sky.temperature) for sky in mapped])
    for sky, row in zip(mapped, rows, strict=True):
        table.add_row(sky.name, *(f"{x:.2f}" for x in row))
    means = [*rows[:, :-1].mean(0), np.sqrt((rows[:, -1] ** 2).mean())]
    table.add_section()
    table.add_row("mean (rms of z)", *(f"{x:.2f}" for x in means))
    for kind in ("pixels", "modes"):
        for k, part in enumerate(getattr(mapped[0], kind).names):
            held = [100 * getattr(sky, kind).values[k, :4, 0] for sky in mapped]
            words = ", ".join(f"{share:.1f}" for share in np.mean(held, axis=0))
            table.add_row(f"{part}: within 50, 68, 90, 95 %", words)
    return table


def draw(mapped: list[Mapped], frequency_mhz: float) -> Figure:
    """A row for each sky: shares less their levels, by band, with their scatter, and the pulls."""
    rows, levels, bands = len(mapped), 100.0 * np.array(LEVELS), mapped[0].pixels.names
    figure = Figure(figsize=(15, 1.6 * rows + 1.6), layout="constrained")
    shape = {"width_ratios": [*(1.0 for _ in bands), 1.3]}
    panels = figure.subplots(rows, len(bands) + 1, squeeze=False, gridspec_kw=shape)
    for line, sky in zip(panels, mapped, strict=True):
        for axes, part in zip(line, sky.pixels.coverage(), strict=False):
            off, scatter = 100.0 * np.array(part.held) - levels, 100.0 * np.array(part.scatter)
            for n, alpha in ((2.0, 0.2), (1.0, 0.25)):
                axes.fill_between(levels, -n * scatter, n * scatter, color=GREY, alpha=alpha, lw=0)
            axes.axhline(0.0, color=GREY, lw=0.6)
            colours = np.where(np.abs(off) <= 2.0 * scatter, BLUE, ORANGE)
            axes.scatter(levels, np.clip(off, -FURTHEST, FURTHEST), c=colours, s=16, zorder=3)
            axes.set(ylim=(-FURTHEST - 3.0, FURTHEST + 3.0), xlim=(46.0, 99.0))
            axes.set_xticks(levels, [f"{level:.0f}" for level in levels])
            axes.set_title(f"{part.name}: rms {part.rms:.2f} ± {part.rms_scatter:.2f}", fontsize=8)
        channel = sky.channel
        pull = modes_to_map(channel.truth - channel.mean, channel.nside) / channel.pixel_std
        image = mollweide(
            line[-1],
            pull,
            norm=Normalize(-WIDEST, WIDEST),
            cmap=DIVERGING,
            highest_altitude=channel.highest_altitude,
        )
        verdict = "hold" if sky.holds(rows) else "do not hold"
        line[0].set_ylabel(f"{sky.name[:18]}\n({verdict})", fontsize=9)
    words = "(truth - mean) / standard deviation"
    colour_bar(figure, image, list(panels[:, -1]), label=words, extend="both")
    figure.suptitle(
        f"{frequency_mhz:g} MHz: share of pixels whose truth an interval of a level [%] holds, "
        "less the level; grey: scatter and twice the scatter",
        fontsize=11,
    )
    return figure


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("skies", nargs="+", help=f"{', '.join(NAMED)} (with :SEED), or files")
    parser.add_argument("--scenario", default="fiducial")
    parser.add_argument("--set", action="append", default=[], help="override of the scenario")
    parser.add_argument("--figure", type=Path, help="where to save the figure")
    options = parser.parse_args()
    scenario = lb.load_scenario(options.scenario, options.set)
    setup, n = set_up(scenario), len(options.skies)
    # their share can be as small as the tests of so many skies ask for
    n_draws = max(1000, round(2 * TESTS * n / FALSE_ALARM))
    mapped = []
    for name, source in map(find_sky, options.skies):
        # noise of its own for each sky, whatever the others are
        made = conditioned(under_sky(setup, source, scenario.seed + zlib.crc32(name.encode())))
        mapped.append(judged(name, made, n_draws))
    table = Table("sky", "part", *(f"{level:.0%}" for level in LEVELS), "rms pull", "largest")
    for sky in mapped:
        for part in (*sky.pixels.coverage(), *sky.modes.coverage()):
            shares = zip(part.held, part.scatter, strict=True)
            table.add_row(
                sky.name,
                part.name,
                *(f"{100 * held:.1f} ± {100 * scatter:.1f}" for held, scatter in shares),
                f"{part.rms:.2f} ± {part.rms_scatter:.2f}",
                f"{part.largest:.1f} ({part.allowed:.1f})",
            )
        table.add_section()
    console = Console(width=130)
    console.print(table)
    console.print(summed_up(mapped))
    for sky in mapped:
        verdict = "hold" if sky.holds(n) else "DO NOT hold"
        console.print(
            f"{sky.name}: error bars {verdict} (p {sky.p_held():.2g} of the shares, "
            f"{sky.p_largest():.2g} of the largest pull)"
        )
    if options.figure is not None:
        draw(mapped, scenario.frequency_mhz).savefig(options.figure, dpi=80)
    return 0 if all(sky.holds(n) for sky in mapped) else 1


if __name__ == "__main__":
    sys.exit(main())
