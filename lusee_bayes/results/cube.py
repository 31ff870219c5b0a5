"""The posterior over the skies of several frequencies: a channel each, or one for all."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import pandas as pd
import xarray as xr
from jaxtyping import Float

from lusee_bayes.core import formats
from lusee_bayes.core.arrays import Array
from lusee_bayes.core.checks import Described, counted, extent
from lusee_bayes.core.harmonics import mode_numbers, synthesis_matrix
from lusee_bayes.core.lazy import healpy
from lusee_bayes.core.progress import about_run
from lusee_bayes.core.reading import rows_of
from lusee_bayes.experiment.scenario import Scenario
from lusee_bayes.experiment.unknowns import UnknownsReport
from lusee_bayes.flight.reduced import Reduced
from lusee_bayes.judge.chi2 import RULE, ChiSquare, Fit
from lusee_bayes.judge.cube_fit import ChannelFits
from lusee_bayes.linear.positive_joint import PositiveMode
from lusee_bayes.results.channel import ChannelResult
from lusee_bayes.results.map_files import about
from lusee_bayes.results.map_result import joint_prior_sentence
from lusee_bayes.sky.galaxy import LANDMARKS
from lusee_bayes.sky.spectral_prior import SpectralPrior

# what summary.json says of a channel, where it is known
FIGURES = (
    *("instrument_chi2", "instrument_chi2_expected", "chi2_model", "chi2", "chi2_expected"),
    *("n_data", "n_missing", "never_observed", "log_evidence", "information_bits"),
)


@dataclass(frozen=True)
class CubeUnknowns:
    """What is told of the unknowns of every channel.

    Attributes
    ----------
    reports : dict of UnknownsReport
        By frequency in MHz.
    octaves : float or None
        Over which receivers' spectra are smooth; None where every frequency has its own power.
    """

    reports: dict[float, UnknownsReport]
    octaves: float | None = None

    @classmethod
    def of(
        cls, channels: Iterable[ChannelResult], octaves: float | None = None
    ) -> CubeUnknowns | None:
        """Of a run's channels; None if they have no such unknowns."""
        reports = {c.frequency_mhz: c.unknowns for c in channels if c.unknowns is not None}
        return cls(reports, octaves) if reports else None

    @property
    def table(self) -> pd.DataFrame:
        """unknowns.csv: the channels' tables, one below the other, with ``frequency_mhz``."""
        tables = [report.table.copy() for report in self.reports.values()]
        for frequency, table in zip(self.reports, tables, strict=True):
            table.insert(0, "frequency_mhz", frequency)
        return pd.concat(tables, ignore_index=True)

    def lines(self) -> list[str]:
        """What a terminal shows: which of them, and which combination, the data do not tell."""
        n, untold = len(self.reports), dict[str, int]()
        for report in self.reports.values():
            for name in report.table["unknown"][~report.told]:
                untold[name] = untold.get(name, 0) + 1
        counts = [f"{name} (at {k} of {n} frequencies)" for name, k in untold.items()]
        what = f"do not tell {', '.join(counts)}" if counts else "tell all of them"
        found = [f"Receivers, ground and gain table: the data {what}."]
        if self.octaves is not None:
            found.append(
                f"Powers of receivers are smooth over {self.octaves:g} octaves: every channel is "
                "given what the others tell of them."
            )
        sentence = self._null_sentence()
        return [*found, sentence] if sentence else found

    def _null_sentence(self) -> str:
        """Of the channel whose data leave most open; empty where all tell most of it."""
        nulls = {f: report.null for f, report in self.reports.items() if report.null is not None}
        left_open = [f for f, null in nulls.items() if null.sentence()]
        if not left_open:
            return ""
        worst = left_open[int(np.argmax([nulls[f].share for f in left_open]))]
        words, share = nulls[worst].words(), nulls[worst].share
        return (
            f"One combination of what looks alike is hardly told at {len(left_open)} of "
            f"{len(nulls)} frequencies. At {worst:g} MHz ({words}, in prior standard deviations) "
            f"it keeps {share:.0%} of its prior variance."
        )


@dataclass(frozen=True, repr=False)
class CubeResult(Described):
    """The posterior of every channel's sky, in K.

    Attributes
    ----------
    scenario : Scenario
        Of several frequencies, those that could not be mapped included.
    channels : tuple of ChannelResult
        That could be mapped.
    components : Components or None
        The component maps that all channels share; None where each has a posterior of its own.
    seconds : dict
        By stage.
    unmapped : dict
        Why the other channels could not be mapped, by frequency in MHz.
    reduced : Reduced or None
        Of flight data: the spectra behind them.
    tie_log_evidence : float
        What smooth spectra of the receivers add to the sum of the channels' ln evidence.
    """

    scenario: Scenario
    channels: tuple[ChannelResult, ...]
    components: Components | None
    seconds: dict[str, float] = field(default_factory=dict)
    unmapped: dict[float, str] = field(default_factory=dict)
    reduced: Reduced | None = None
    tie_log_evidence: float = 0.0

    def description(self) -> tuple[str, ...]:
        kind = "independent channel" if self.components is None else "joint channel"
        return (
            f"{counted(len(self.channels), kind)}, {extent(self.frequencies_mhz, 'MHz')}, "
            f"lmax = {self.scenario.lmax}",
            self.verdict(),
        )

    @property
    def frequencies_mhz(self) -> Float[np.ndarray, " channels"]:
        """Of the channels that could be mapped."""
        return np.array([channel.frequency_mhz for channel in self.channels])

    def stacked(self, name: str) -> np.ndarray | None:
        """An attribute of the channels, channels first; None where it is not known of all."""
        values = [getattr(channel, name) for channel in self.channels]
        return None if any(v is None for v in values) else np.stack(values)

    def snr(self, *, independent: bool = False) -> Float[np.ndarray, "channels ells"] | None:
        """SNR_ell of every channel, or of the means given its own data alone; None if unknown."""
        if self.stacked("truth") is None or (independent and self.stacked("independent") is None):
            return None
        return np.stack([c.snr(c.independent if independent else None) for c in self.channels])

    def fits(self) -> ChannelFits:
        """chi^2 of every channel, and the tests of all of them together."""
        chi2, degrees = self.stacked("instrument_chi2"), self.stacked("instrument_chi2_expected")
        components, n_data = self.components, float(self.stacked("n_data").sum())
        joint = components is not None
        total = components.chi2 if joint else float(self.stacked("chi2_model").sum())
        rest = ChiSquare(total - float(chi2.sum()), n_data - float(degrees.sum()))
        return ChannelFits(self.frequencies_mhz, chi2, degrees, rest, joint)

    @cached_property
    def fit(self) -> Fit:
        """Whether the data of all channels fit."""
        return self.fits().fit()

    @cached_property
    def unknowns(self) -> CubeUnknowns | None:
        """Receivers, ground and gain table, where the model has them."""
        tied = self.scenario.ties_receivers
        octaves = self.scenario.noise.receiver.smooth_octaves if tied else None
        return CubeUnknowns.of(self.channels, octaves)

    def verdict(self) -> str:
        """What the residuals say, in sentences."""
        return self.fit.text

    def headline(self) -> str:
        """The few figures that matter, in one line."""
        kind = "each on its own" if self.components is None else "one posterior"
        if self.scenario.ties_receivers:
            kind = "each on its own but for smooth spectra of receivers"
        parts = [f"{counted(len(self.channels), 'frequency', 'frequencies')}, {kind}"]
        crosses = [c.ell_cross for c in self.channels if c.ell_cross is not None]
        if crosses:
            parts.append(f"SNR < 1 first at ell {min(crosses)} to {max(crosses)}")
        parts.append(f"ln evidence {self.log_evidence:.1f}")
        components = self.components
        if components is not None and components.iterations:
            parts.append(
                f"{components.iterations} iterations, {components.refinement:.1g} sigma left"
            )
        return ", ".join(parts)

    def lines(self) -> list[str]:
        """What a terminal shows."""
        prior = [] if self.components is None else [joint_prior_sentence(self.scenario)]
        unknowns = [] if self.unknowns is None else self.unknowns.lines()
        reduced = self.reduced
        notes = () if reduced is None else (reduced.flag_line().capitalize(), *reduced.notes())
        told = [self.headline(), *prior, *unknowns, self.verdict(), RULE]
        return [*told, *self.doubts(), *self.gaps(), *notes]

    def doubts(self) -> list[str]:
        """What is doubtful about the data, with the channel."""
        return [f"{c.frequency_mhz:g} MHz: {d}" for c in self.channels for d in c.doubts]

    def gaps(self) -> list[str]:
        """Which channels could not be mapped, and why, a sentence each."""
        return [f"Not mapped, {f:g} MHz: {reason}" for f, reason in self.unmapped.items()]

    @property
    def log_evidence(self) -> float:
        """ln p of all data."""
        if self.components is None:
            alone = float(np.sum([channel.log_evidence for channel in self.channels]))
            return alone + self.tie_log_evidence
        return self.components.log_evidence

    def landmarks(self) -> dict[str, dict[str, np.ndarray]]:
        """Brightness, its standard deviation and, if known, the truth of some directions."""
        nside = self.scenario.map_nside
        mean, pixel_std, truth = (self.stacked(n) for n in ("mean", "pixel_std", "truth"))
        found = {}
        for name, (lon, lat) in LANDMARKS.items():
            pixel = healpy.ang2pix(nside, lon, lat, lonlat=True)
            theta, phi = healpy.pix2ang(nside, pixel)
            y = synthesis_matrix(np.array([theta]), np.array([phi]), self.scenario.lmax)[0]
            found[name] = {"mean": mean @ y, "std": pixel_std[:, pixel]}
            if truth is not None:
                found[name]["truth"] = truth @ y
        return found

    def pulls(self) -> list[dict[str, object]]:
        """How far the means of some directions are from the truth, in standard deviations."""
        found = []
        for name, values in self.landmarks().items():
            if "truth" not in values:
                return []
            pull = (values["mean"] - values["truth"]) / values["std"]
            worst = int(np.argmax(np.abs(pull)))
            rms, frequency = float(np.sqrt((pull**2).mean())), float(self.frequencies_mhz[worst])
            row = {"direction": name, "rms": rms, "worst": float(pull[worst])}
            found.append({**row, "worst_mhz": frequency})
        return found

    def summary(self) -> dict[str, object]:
        """Figures of summary.json."""
        channels = []
        for channel, p in zip(self.channels, self.fits().p().tolist(), strict=True):
            numbers = {"instrument_p": p} | {name: getattr(channel, name) for name in FIGURES}
            known = {name: value for name, value in numbers.items() if not np.isnan(value)}
            if channel.coverage:
                known["coverage"] = channel.coverage_rows()
            if channel.unknowns is not None:
                known["unknowns"] = channel.unknowns.summary()
            channels.append(
                {"frequency_mhz": channel.frequency_mhz, "ell_cross": channel.ell_cross, **known}
            )
        return {
            "frequencies_mhz": self.frequencies_mhz.tolist(),
            "unmapped": self.gaps(),
            "joint": self._joint_summary(),
            "tied": self.scenario.ties_receivers,
            "log_evidence": self.log_evidence,
            "n_data": sum(channel.n_data for channel in self.channels),
            "n_modes": len(self.channels[0].mean),
            "level": self.fit.level,
            "verdict": self.fit.text,
            "doubts": self.doubts(),
            "tests": [
                {"test": t.name, "found": t.found, "p": t.p, "among": t.n, "level": t.level}
                for t in self.fits().tests()
            ],
            "pulls": self.pulls(),
            "unknowns": [] if self.unknowns is None else self.unknowns.lines(),
            "channels": channels,
            **about_run(self.seconds),
        }

    def _joint_summary(self) -> dict[str, object] | None:
        components = self.components
        if components is None:
            return None
        return {
            "prior": joint_prior_sentence(self.scenario),
            "components": list(components.prior.names),
            "solver": components.solver,
            "iterations": components.iterations,
            "chi2": components.chi2,
            "log_evidence": components.log_evidence,
            "information_bits": components.information_bits,
            "refinement_sigma": components.refinement,
        }

    def spectra(self) -> list[dict[str, float]]:
        """Rows of spectra.csv: one for every channel and ell."""
        rows = []
        for channel in self.channels:
            columns = {name: v.astype(np.float64) for name, v in channel.spectra().items()}
            for ell, row in enumerate(rows_of(columns)):
                rows.append({"frequency_mhz": channel.frequency_mhz, **row, "ell": ell})
        return rows

    def to_dataset(self) -> xr.Dataset:
        """posterior.nc: on dims ``frequency`` and ``mode`` (``draw``), in K."""
        scenario, components = self.scenario, self.components
        ell, m = mode_numbers(scenario.lmax)
        parts = [channel.variables() for channel in self.channels]
        stacked = {name: np.stack([part[name][1] for part in parts]) for name in parts[0]}
        variables = {
            name: (("frequency", *dims), stacked[name], {"units": "K"})
            for name, (dims, _) in parts[0].items()
        }
        if components is not None:
            maps, mixing = np.asarray(components.mean), np.asarray(components.prior.mixing)
            # fields of positive skies may have more modes than the maps
            dims = ("component", "mode" if components.mode is None else "field_mode")
            unit = "K" if components.mode is None else "1"
            variables["component_mean"] = (dims, maps, {"units": unit})
            variables["mixing"] = (("frequency", "component"), mixing, {"units": "1"})
        return xr.Dataset(
            variables,
            coords={
                "frequency": ("frequency", self.frequencies_mhz, {"units": "MHz"}),
                "ell": ("mode", ell),
                "m": ("mode", m),
            },
            attrs={
                "format": formats.POSTERIOR_CUBE,
                **about(scenario),
                **({"unmapped": "\n".join(self.gaps())} if self.unmapped else {}),
            },
        )

    def maps(self) -> dict[str, Float[np.ndarray, "channels pixels"]]:
        """Cubes by name, in K: mean, std and, where the truth is known, truth and residual."""
        parts = [channel.maps() for channel in self.channels]
        return {name: np.stack([part[name] for part in parts]) for name in parts[0]}


@dataclass(frozen=True)
class Components:
    """The joint posterior of the component maps: in K, of positive skies fields without unit.

    Attributes
    ----------
    prior : SpectralPrior
    mean : (components, modes) array
    spread : (pairs, modes, modes) array
        Their covariance (:func:`.paired`).
    draws : (n, components, modes) array
    chi2 : float
        Of all data under the model, prior included: chi^2 of N_data if it holds.
    log_evidence, information_bits : float
    refinement : float
        Distance left, in standard deviations.
    mode : PositiveMode or None
        Of positive skies.
    """

    prior: SpectralPrior
    mean: Array
    spread: Array
    draws: Array
    chi2: float
    log_evidence: float
    information_bits: float
    refinement: float
    mode: PositiveMode | None = None

    @property
    def solver(self) -> str:
        """How the mean was found."""
        return "direct" if self.mode is None else "Gauss-Newton rounds"

    @property
    def iterations(self) -> int:
        """Rounds of positive skies."""
        return 0 if self.mode is None else self.mode.rounds
