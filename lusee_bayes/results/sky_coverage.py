"""Coverage of given skies: each is mapped, and its truth compared with the error bars.

Two tests of each sky, both against draws of its posterior: the share or rms pull, of any band of
latitude or group of multipoles, that is furthest from what is expected; and the largest pull of
the whole sky.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from lusee_bayes.core.harmonics import modes_to_map
from lusee_bayes.core.progress import peak_memory_gb
from lusee_bayes.core.version import versions
from lusee_bayes.experiment.scenario import Scenario
from lusee_bayes.linear.levels import LEVELS
from lusee_bayes.results.channel import ChannelResult
from lusee_bayes.results.coverage import Counts, Coverage, p_of_largest, p_of_shares
from lusee_bayes.results.draws import deviations
from lusee_bayes.results.errors import errors_by_latitude, snr_at_some_ell
from lusee_bayes.results.map_result import MapResult

# chance that a run fails whose error bars are right
FALSE_ALARM = 0.01
TESTS = 2
# parts that are named in a sentence
NAMED = 3


def draws_needed(n_skies: int) -> int:
    """Number of draws whose share can be as small as the tests of so many skies ask for."""
    return max(1000, round(2 * TESTS * n_skies / FALSE_ALARM))


@dataclass(frozen=True)
class SkyCoverage:
    """The map of one given sky against its truth.

    Attributes
    ----------
    name : str
    channel : ChannelResult
    pixels, modes : Counts
        Pulls by latitude and by multipole, of the truth and of draws.
    level, verdict : str
        Whether the data fit the model.
    """

    name: str
    channel: ChannelResult
    pixels: Counts
    modes: Counts
    level: str
    verdict: str

    @classmethod
    def of(cls, name: str, result: MapResult, n_draws: int) -> SkyCoverage:
        """Count over ``n_draws`` draws of a map's posterior."""
        channel = result.channel
        error = channel.truth - channel.mean
        drawn = deviations(result.experiment, result.inference.posterior, n_draws)
        return cls(
            name,
            channel,
            Counts.of_pixels(channel.pixel_std, error, drawn),
            Counts.of_modes(channel.std, error, drawn),
            str(result.diagnostics.attrs["level"]),
            result.verdict(),
        )

    def pull(self) -> Float[np.ndarray, " pixels"]:
        """Compute (truth - mean) / std of every pixel."""
        channel = self.channel
        return modes_to_map(channel.truth - channel.mean, channel.nside) / channel.pixel_std

    def parts(self) -> tuple[Coverage, ...]:
        """Coverage by latitude, then by multipole."""
        return (*self.pixels.coverage(), *self.modes.coverage())

    def p_held(self) -> float:
        """:func:`.p_of_shares` by latitude and multipole."""
        return p_of_shares(self.pixels, self.modes)

    def p_largest(self) -> float:
        """:func:`.p_of_largest` over the whole sky."""
        return p_of_largest(self.pixels)

    def p(self, n_skies: int) -> float:
        """The smaller of both times the number of all tests: below any bound at most that often."""
        return min(1.0, TESTS * n_skies * min(self.p_held(), self.p_largest()))

    def errors(self) -> list[dict[str, float | str]]:
        """:func:`.errors_by_latitude`."""
        return errors_by_latitude(self.channel)

    def snr(self) -> dict[int, float]:
        """:func:`.snr_at_some_ell`."""
        return snr_at_some_ell(self.channel)

    def reasons(self) -> list[str]:
        """The parts whose error bars are furthest from right, in words, the furthest first."""
        off = []
        for part in self.parts():
            known = [k for k, scatter in enumerate(part.scatter) if scatter > 0]
            if not known:
                continue
            far = [(part.held[k] - LEVELS[k]) / part.scatter[k] for k in known]
            k, most = max(zip(known, far, strict=True), key=lambda one: abs(one[1]))
            wrong = "too wide" if most > 0 else "too narrow"
            share = f"{part.held[k]:.1%} ± {100 * part.scatter[k]:.1f}"
            words = f"{part.name} {wrong} ({LEVELS[k]:.0%} intervals hold {share})"
            off.append((abs(most), words))
        return [text for _, text in sorted(off, reverse=True)[:NAMED]]

    def sentence(self, n_skies: int) -> str:
        """The verdict on this sky."""
        told = f"p {self.p_held():.2g} of the shares, {self.p_largest():.2g} of the largest pull"
        if self.p(n_skies) >= FALSE_ALARM:
            return f"{self.name}: error bars hold ({told})"
        whole = self.pixels.coverage()[-1]
        largest = f"largest pull {whole.largest:.1f} (95% of draws: below {whole.allowed:.1f})"
        return (
            f"{self.name}: error bars do not hold ({told}): {'; '.join([*self.reasons(), largest])}"
        )


@dataclass(frozen=True)
class SkiesResult:
    """Given skies, each mapped with the prior of one scenario.

    Attributes
    ----------
    name : str
        Of the scenario.
    scenario : Scenario
    skies : tuple of SkyCoverage
    n_draws : int
        Draws of each posterior that the counts are compared with.
    seconds : dict
        By stage.
    """

    name: str
    scenario: Scenario
    skies: tuple[SkyCoverage, ...]
    n_draws: int
    seconds: dict[str, float] = field(default_factory=dict)

    def held(self, sky: SkyCoverage) -> bool:
        """Whether a sky's error bars are as right as chance allows."""
        return sky.p(len(self.skies)) >= FALSE_ALARM

    @property
    def passed(self) -> bool:
        """Whether those of all skies are."""
        return all(map(self.held, self.skies))

    def headline(self) -> str:
        """The verdict, in one line."""
        good = sum(map(self.held, self.skies))
        verdict = "passed" if self.passed else "FAILED"
        return f"{verdict}: error bars hold for {good} of {len(self.skies)} skies"

    def thresholds(self) -> str:
        """How the verdict comes about."""
        return (
            f"Fails if p times {TESTS} tests times {len(self.skies)} skies is below "
            f"{FALSE_ALARM:g}: a run whose error bars are right fails once in "
            f"{1.0 / FALSE_ALARM:.0f}. p is the share of {self.n_draws} draws of each posterior "
            "that are as far out."
        )

    def rows(self) -> list[dict[str, float | str]]:
        """Rows of coverage.csv: one for every sky and part."""
        return [{"sky": sky.name, **part.row()} for sky in self.skies for part in sky.parts()]

    def as_json(self) -> dict[str, object]:
        """coverage.json."""
        n = len(self.skies)
        return {
            "passed": self.passed,
            "verdict": f"{self.headline()}.",
            "thresholds": self.thresholds(),
            "frequency_mhz": self.scenario.frequency_mhz,
            "draws": self.n_draws,
            "levels": list(LEVELS),
            "skies": [
                {
                    "name": sky.name,
                    "passed": self.held(sky),
                    "sentence": sky.sentence(n),
                    "p_held": sky.p_held(),
                    "p_largest": sky.p_largest(),
                    "log_evidence": sky.channel.log_evidence,
                    "chi2_model": sky.channel.chi2_model,
                    "n_data": sky.channel.n_data,
                    "level": sky.level,
                    "verdict": sky.verdict,
                    "snr": {str(ell): value for ell, value in sky.snr().items()},
                    "errors": sky.errors(),
                    "coverage": [part.row() for part in sky.parts()],
                }
                for sky in self.skies
            ],
            "seconds": {name: round(s, 3) for name, s in self.seconds.items()},
            "peak_memory_gb": round(peak_memory_gb(), 3),
            "versions": versions(),
        }

    def as_markdown(self) -> str:
        """coverage.md: verdicts, figures of every sky, and coverage."""
        lines = [f"# Error bars of {self.name} on given skies", "", f"{self.headline()}.", ""]
        lines += [f"- {sky.sentence(len(self.skies))}" for sky in self.skies]
        lines += ["", self.thresholds(), "", *_figures_table(self.skies)]
        lines += [
            "",
            "Share of pixels, or of modes, whose truth lies within central intervals; rms and "
            "largest of the pulls (truth - mean) / std, in brackets what the largest of 95 % of "
            "draws does not exceed; ± the scatter if the posterior is right.",
            "",
            "| sky | part | n | "
            + " | ".join(f"{level:.0%}" for level in LEVELS)
            + " | rms | largest |",
            "| --- | --- | ---" + " | ---" * (len(LEVELS) + 2) + " |",
        ]
        return "\n".join([*lines, *_coverage_rows(self.skies)]) + "\n"


def _figures_table(skies: tuple[SkyCoverage, ...]) -> Iterator[str]:
    ells = list(skies[0].snr())
    bands = [band["name"] for band in skies[0].errors()]
    snr = " | ".join(f"SNR at ell {ell}" for ell in ells)
    width = " | ".join(f"std / sky, {name}".replace("|", "\\|") for name in bands[:-1])
    chi2 = f"chi^2 ({skies[0].channel.n_data} data)"
    yield f"| sky | ln evidence | {chi2} | rms error | {snr} | {width} |"
    yield "| --- |" + " --- |" * (3 + len(ells) + len(bands) - 1)
    for sky in skies:
        errors, channel = sky.errors(), sky.channel
        cells = [
            sky.name,
            f"{channel.log_evidence:.1f}",
            f"{channel.chi2_model:.0f}",
            f"{errors[-1]['rms_error_k']:.4g} K",
            *(f"{value:.2f}" for value in sky.snr().values()),
            *(f"{band['std_over_sky']:.2f}" for band in errors[:-1]),
        ]
        yield f"| {' | '.join(cells)} |"


def _coverage_rows(skies: tuple[SkyCoverage, ...]) -> Iterator[str]:
    for sky in skies:
        for part in sky.parts():
            shares = [
                f"{100 * held:.1f} ± {100 * scatter:.1f}"
                for held, scatter in zip(part.held, part.scatter, strict=True)
            ]
            cells = [
                sky.name,
                part.name.replace("|", "\\|"),
                str(part.n),
                *shares,
                f"{part.rms:.2f} ± {part.rms_scatter:.2f}",
                f"{part.largest:.1f} ({part.allowed:.1f})",
            ]
            yield f"| {' | '.join(cells)} |"
