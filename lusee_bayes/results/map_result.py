"""The result of a map run: the posterior of every channel's sky, and whether the data fit.

A map of one frequency has one channel. Several channels have independent posteriors, or share the
posterior of component maps.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from textwrap import wrap

import numpy as np
import pandas as pd
from astropy.table import Table
from jaxtyping import Float

from lusee_bayes.core import harmonics, lazy, progress
from lusee_bayes.core.arrays import Array
from lusee_bayes.core.checks import Described, counted, extent, with_error
from lusee_bayes.experiment.experiment import Experiment
from lusee_bayes.experiment.scenario import Scenario
from lusee_bayes.experiment.unknowns import flux_lines
from lusee_bayes.flight.reduced import Reduced
from lusee_bayes.judge.chi2 import RULE, ChiSquare, Fit, in_brief
from lusee_bayes.judge.cube_fit import ChannelFits, SharedTest
from lusee_bayes.linear.joint import Blocks
from lusee_bayes.linear.positive_joint import PositiveMode
from lusee_bayes.results.channel import ChannelResult
from lusee_bayes.results.sky_spectrum import OBSERVED, IndexMaps, SkySpectrum
from lusee_bayes.results.summaries import JointSummary, MapSummary, PullSummary
from lusee_bayes.sky.galaxy import LANDMARKS
from lusee_bayes.sky.spectral_prior import SpectralPrior

# smallest part of the sky in which channels have observed other parts of it; what one sky above
# lmax for all channels may add to chi^2, in roots of its degrees of freedom
OTHER, ADDED = 0.01, 15.0


def prior_sentence(experiment: Experiment) -> str:
    """The prior's model, the source of its C_ell and, if it was learned, its parameters."""
    section, prior = experiment.scenario.prior, experiment.learned
    rows = [] if prior is None else prior.as_rows()
    learned = ", ".join(f"{r['name']}: {with_error(r['value'], r['std'])}" for r in rows)
    return f"Prior {section.model}, C_ell {section.origin}{'; ' if rows else ''}{learned}."


def joint_prior_sentence(scenario: Scenario) -> str:
    """The prior of the skies in a scenario's joint posterior, in a sentence."""
    section, kept = scenario.spectral, f"prior.model={scenario.prior.model} is not used"
    if section.model == "positive":
        sky = f"the embedded template times the exponential of {', '.join(section.fields)}"
        return f"Prior spectral.model=positive: {sky}, with C_ell learned from these data; {kept}."
    return f"Prior spectral.model={section.model}, C_ell from the scenario's skies; {kept}."


def spectrum_of(channels: Sequence[ChannelResult]) -> SkySpectrum:
    """Temperatures of regions of the sky in all channels.

    The observed sky gets another name if channels have not observed the same.
    """
    made = SkySpectrum.of([(c.frequency_mhz, c.temperatures, c.departure) for c in channels])
    seen = np.stack([channel.highest_altitude >= 0.0 for channel in channels])
    if (seen.any(0) & ~seen.all(0)).mean() < OTHER:
        return made
    names = [f"{name} of each channel" if name == OBSERVED else name for name in made.regions]
    return replace(made, regions=tuple(names))


def below(tables: dict[float, pd.DataFrame | None]) -> pd.DataFrame | None:
    """Concatenate tables of channels, with ``frequency_mhz`` first; None without any."""
    present = {f: table for f, table in tables.items() if table is not None}
    if not present:
        return None
    return pd.concat(present, names=["frequency_mhz"]).reset_index(0).reset_index(drop=True)


@dataclass(frozen=True)
class Components:
    """The joint posterior of the component maps, in K (for positive skies: unitless fields).

    Attributes
    ----------
    prior : SpectralPrior
    mean : (unknowns,) array
        The maps one after another, then the instrument's shared unknowns.
    spread : tuple of arrays
        Their covariance (:func:`.paired`).
    draws : (n, unknowns) array
    chi2 : float
        chi^2 of all data under the model, prior included: N_data degrees of freedom.
    log_evidence, information_bits : float
    refinement : float
        Last correction of the mean, in standard deviations.
    mode : PositiveMode or None
        For positive skies.
    misfit_above : float
        What the common sky above lmax adds to chi^2 of the channels (:meth:`.AlikeAbove.misfit`).
    """

    prior: SpectralPrior
    mean: Array
    spread: Blocks
    draws: Array
    chi2: float
    log_evidence: float
    information_bits: float
    refinement: float
    mode: PositiveMode | None = None
    misfit_above: float = 0.0

    @property
    def maps(self) -> Float[np.ndarray, "components modes"]:
        """Mean of the component maps."""
        shape = np.shape(self.prior.roots)
        return self.mean[: shape[0] * shape[1]].reshape(shape)

    @property
    def iterations(self) -> int:
        """Number of rounds for positive skies, else 0."""
        return 0 if self.mode is None else self.mode.rounds


@dataclass(frozen=True, repr=False)
class MapResult(Described):
    """The posterior of every channel's sky, in K.

    Attributes
    ----------
    scenario : Scenario
        With one or several frequencies, including those that could not be mapped.
    channels : tuple of ChannelResult
        The mapped channels.
    joint : Components or None
        The component maps that all channels share; None if channels have separate posteriors.
    seconds : dict
        By stage.
    unmapped : dict
        Why the other channels could not be mapped, by frequency in MHz.
    reduced : Reduced or None
        The spectra behind flight data.
    tie_log_evidence : float
        ln evidence that sharing the instrument adds to the sum over channels.
    shared_tests : tuple of SharedTest
        Whether each channel agrees with the others about the shared instrument.
    """

    scenario: Scenario
    channels: tuple[ChannelResult, ...]
    joint: Components | None = None
    seconds: dict[str, float] = field(default_factory=dict)
    unmapped: dict[float, str] = field(default_factory=dict)
    reduced: Reduced | None = None
    tie_log_evidence: float = 0.0
    shared_tests: tuple[SharedTest, ...] = ()

    def description(self) -> tuple[str, ...]:
        if self.single:
            sizes = f"{self.channel.n_data} data"
            head = f"{self.channel.frequency_mhz:g} MHz, lmax = {self.scenario.lmax}, {sizes}"
            return head, self.headline(), *wrap(self.verdict(), 100)[:2]
        kind = "independent channel" if self.joint is None else "joint channel"
        return (
            f"{counted(len(self.channels), kind)}, {extent(self.frequencies_mhz, 'MHz')}, "
            f"lmax = {self.scenario.lmax}",
            self.verdict(),
        )

    @property
    def single(self) -> bool:
        """Whether the scenario has one frequency."""
        return self.scenario.single

    @property
    def channel(self) -> ChannelResult:
        """The first channel, which is the only one in a map of one frequency."""
        return self.channels[0]

    @property
    def frequencies_mhz(self) -> Float[np.ndarray, " channels"]:
        """Frequencies of the mapped channels."""
        return np.array([channel.frequency_mhz for channel in self.channels])

    def stacked(self, name: str) -> np.ndarray | None:
        """Stack an attribute of the channels, channels first; None if any channel lacks it."""
        values = [getattr(channel, name) for channel in self.channels]
        return None if any(v is None for v in values) else np.stack(values)

    def fits(self) -> ChannelFits:
        """chi^2 of every channel, and the joint tests."""
        parts, joint = tuple(c.instrument for c in self.channels), self.joint is not None
        chi2, seen_above = self.stacked("chi2_model").sum(), self.stacked("seen_above")
        if joint:  # the prior of the map is not that of the sky above lmax, unless that is far off
            chi2 = self.joint.chi2 - min(self.joint.misfit_above, ADDED * seen_above.sum() ** 0.5)
        chi2 = float(chi2) - sum(part.chi2 for part in parts)
        degrees = float(self.stacked("n_data").sum()) - sum(part.degrees for part in parts)
        # one sky in all channels: their parts may be as good as the same, and a mean is no surer
        n = 1 if joint else len(parts)
        prior = ChiSquare(chi2 / n, degrees / n)
        if not joint and (known := [c.prior_of_all for c in self.channels])[0] is not None:
            prior = ChiSquare(sum(k.chi2 for k in known) / n, sum(k.degrees for k in known) / n)
        learned = any(c.log_evidence_learned is not None for c in self.channels)
        more = joint, self.shared_tests, learned, tuple(seen_above.tolist())
        return ChannelFits(self.frequencies_mhz, parts, prior, *more)

    @cached_property
    def fit(self) -> Fit:
        """Whether the data of all channels fit."""
        if self.single:
            return self.channel.judged.fit
        fit = self.fits().fit()
        blamed = [
            f"{c.frequency_mhz:g} MHz: {c.judged.fit.details}"
            for c in self.channels
            if c.judged is not None and c.judged.level == "does not fit"
        ]
        return Fit(fit.level, " ".join([fit.details, *blamed[:NAMED]]))

    def unknowns(self) -> list[str]:
        """Unconstrained receivers, ground and gain table, in sentences; for one channel, all."""
        reports = {c.frequency_mhz: c.unknowns for c in self.channels if c.unknowns is not None}
        if len(reports) < 2:
            return [line for report in reports.values() for line in report.lines()]
        tables = [(report.table["unknown"], report.constrained) for report in reports.values()]
        weak = Counter(name for names, constrained in tables for name in names[~constrained])
        counts = [f"{name} (at {k} of {len(reports)} frequencies)" for name, k in weak.items()]
        what = f"do not constrain {', '.join(counts)}" if counts else "constrain all of them"
        lines = [f"Receivers, ground and gain table: the data {what}."]
        apart = [f"{t.frequency_mhz:g} MHz" for t in self.shared_tests if t.disagrees]
        where = f"all frequencies but {in_brief(apart)}" if apart else "all frequencies"
        for words, octaves in self.scenario.shared.items():
            like = "the same" if np.isinf(octaves) else f"smooth over {octaves:g} octaves"
            given = "every channel uses the constraints from all others"
            lines.append(f"Unknowns of {words} are {like} at {where}: {given}.")
        nulls = {f: report.null for f, report in reports.items() if report.null is not None}
        if left_open := [f for f, null in nulls.items() if null.sentence()]:
            worst = max(left_open, key=lambda f: nulls[f].share)
            lines.append(
                f"One parameter combination is nearly unconstrained at {len(left_open)} of "
                f"{len(nulls)} frequencies. At {worst:g} MHz ({nulls[worst].words()}, in prior "
                f"standard deviations) its variance is {nulls[worst].share:.0%} of the prior's."
            )
        return lines

    def table(self, name: str, part: str = "") -> pd.DataFrame | None:
        """A table of all channels: an attribute of each, or a part of that attribute."""
        columns = {c.frequency_mhz: getattr(c, name) for c in self.channels}
        if part:
            columns = {f: held and getattr(held, part) for f, held in columns.items()}
        return below(columns)

    def verdict(self) -> str:
        """The verdict on the residuals, in sentences."""
        return self.fit.text

    def headline(self) -> str:
        """The main figures, in one line."""
        if self.single:
            return ", ".join(self.channel.figures())
        kind = "solved independently" if self.joint is None else "one posterior"
        if self.scenario.shared and self.joint is None and len(self.channels) > 1:
            kind += " except for the instrument that they share"
        parts = [f"{counted(len(self.channels), 'frequency', 'frequencies')}, {kind}"]
        if crosses := [c.ell_cross for c in self.channels if c.ell_cross is not None]:
            parts.append(f"SNR < 1 first at ell {min(crosses)} to {max(crosses)}")
        parts.append(f"ln evidence {self.log_evidence:.1f}")
        joint = self.joint
        if joint is not None and joint.iterations:
            parts.append(f"{joint.iterations} iterations, {joint.refinement:.1g} sigma left")
        return ", ".join(parts)

    def lines(self, *, verbose: bool = True) -> list[str]:
        """Lines for a terminal: remarks, then the verdict and the main numbers.

        Details of the verdict, its causes, prior and unknowns come first, unless the verdict is
        "consistent", without any usual mistake that fits better, and ``verbose`` is false.
        """
        found = any(c.diagnosis is not None and c.diagnosis.proposals for c in self.channels)
        details = self._details() if verbose or found or self.fit.level != "consistent" else []
        remarks = *self.remarks("doubts"), *self.remarks("notes"), *self.gaps(), *self._flags()
        return [*details, *remarks, self.fit.headline, self.headline()]

    def _details(self) -> list[str]:
        lines = [self.fit.details]
        for channel in self.channels:
            label = "" if self.single else f"{channel.frequency_mhz:g} MHz: "
            causes = [] if channel.diagnosis is None else channel.diagnosis.sentences()
            fluxes = [] if channel.fluxes is None else flux_lines(channel.fluxes)
            offsets = [] if channel.pointing is None else channel.pointing.lines()
            prior = [channel.prior] if self.single else []
            lines += [f"{label}{line}" for line in (*causes, *prior, *fluxes, *offsets)]
        lines += [] if self.joint is None else [joint_prior_sentence(self.scenario)]
        return [*lines, *self.unknowns(), f"{RULE}."]

    def _flags(self) -> list[str]:
        """The flagged share of flight data, and doubts about them."""
        if (reduced := self.reduced) is None:
            return []
        if not self.single:
            return [reduced.flag_line().capitalize(), *reduced.notes()]
        band = reduced.band(self.channel.frequency_mhz)
        line = reduced.flag_line(band, self.channel.flagged_share)
        return [line.capitalize(), *reduced.doubts(band), *reduced.notes()]

    def remarks(self, kind: str) -> list[str]:
        """``doubts`` or ``notes``, with the frequency if there are several channels."""
        if self.single:
            return list(getattr(self.channel, kind))
        return [f"{c.frequency_mhz:g} MHz: {x}" for c in self.channels for x in getattr(c, kind)]

    def gaps(self) -> list[str]:
        """The channels that could not be mapped, and why, a sentence each."""
        return [f"Not mapped, {f:g} MHz: {reason}" for f, reason in self.unmapped.items()]

    @property
    def log_evidence(self) -> float:
        """ln p of all data."""
        if self.joint is not None:
            return self.joint.log_evidence
        alone = float(np.sum([channel.log_evidence for channel in self.channels]))
        return alone + self.tie_log_evidence

    def landmarks(self) -> dict[str, dict[str, np.ndarray]]:
        """Brightness, its standard deviation and, if known, its truth in some directions."""
        nside, truth = self.scenario.map_nside, self.stacked("truth")
        pixels = lazy.healpy.ang2pix(nside, *np.transpose([*LANDMARKS.values()]), lonlat=True)
        y = harmonics.synthesis_matrix(*lazy.healpy.pix2ang(nside, pixels), self.scenario.lmax).T
        values = {"mean": self.stacked("mean") @ y, "std": self.stacked("pixel_std")[:, pixels]}
        if truth is not None:
            values["truth"] = truth @ y
        return {name: {n: x[:, k] for n, x in values.items()} for k, name in enumerate(LANDMARKS)}

    def pulls(self) -> list[PullSummary]:
        """How far the means of some directions are from the truth, in standard deviations."""
        pulls = []
        for name, values in self.landmarks().items():
            if "truth" not in values:
                return []
            pull = (values["mean"] - values["truth"]) / values["std"]
            worst = int(np.argmax(np.abs(pull)))
            where = {"direction": name, "worst_mhz": self.frequencies_mhz[worst]}
            pulls.append(PullSummary(**where, rms=np.sqrt((pull**2).mean()), worst=pull[worst]))
        return pulls

    def summary(self) -> MapSummary:
        """Figures of summary.json."""
        return MapSummary(
            frequencies_mhz=self.frequencies_mhz.tolist(),
            unmapped=self.gaps(),
            joint=self._joint_summary(),
            tied=bool(self.scenario.shared),
            level=self.fit.level,
            verdict=self.fit.text,
            log_evidence=self.log_evidence,
            n_data=sum(channel.n_data for channel in self.channels),
            n_modes=len(self.channel.mean),
            doubts=self.remarks("doubts"),
            notes=self.remarks("notes"),
            tests=[] if self.single else self.fits().tests(),
            shared=self.shared_tests,
            pulls=[] if self.single else self.pulls(),
            unknowns=self.unknowns(),
            channels=list(self.channels),
            **progress.about_run(self.seconds),
        )

    def _joint_summary(self) -> JointSummary | None:
        if (joint := self.joint) is None:
            return None
        named = {"prior": joint_prior_sentence(self.scenario), "components": joint.prior.names}
        named["solver"] = "direct" if joint.mode is None else "Gauss-Newton rounds"
        same = set(JointSummary.model_fields) - set(named)
        return JointSummary(**named, **{name: getattr(joint, name) for name in same})

    def sky_spectrum(self) -> SkySpectrum:
        """Temperatures of regions of the sky."""
        return spectrum_of(self.channels)

    def index_maps(self) -> IndexMaps | None:
        """Maps of the spectral index of a joint posterior; None for less than three channels."""
        if self.joint is None or len(self.channels) < 3:
            return None
        cells = np.stack([channel.temperatures.cells for channel in self.channels])
        return IndexMaps.of(self.frequencies_mhz, cells)

    def spectra(self) -> Table:
        """power_spectra.ecsv: a row for every channel and ell."""
        rows = below({c.frequency_mhz: pd.DataFrame(c.spectra()) for c in self.channels})
        units = {name: "K2" for name in rows if name.startswith("cl_")}
        return Table.from_pandas(rows, units=units | {"frequency_mhz": "MHz"})

    def maps(self) -> dict[str, Float[np.ndarray, "channels pixels"]]:
        """Cubes by name, in K: mean, std and, if the truth is known, truth and residual."""
        parts = [channel.maps() for channel in self.channels]
        return {name: np.stack([part[name] for part in parts]) for name in parts[0]}


# number of channels whose verdicts the run's verdict includes
NAMED = 4
