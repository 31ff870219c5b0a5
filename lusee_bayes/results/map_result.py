"""A posterior map at one frequency, with what is needed to judge it.

Beside the map are the fluxes of point sources, and where its prior comes from.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from textwrap import wrap
from typing import Any

import pandas as pd
import xarray as xr

from lusee_bayes.core.checks import Described
from lusee_bayes.core.progress import about_run
from lusee_bayes.experiment.diagnosis import Diagnosis
from lusee_bayes.experiment.experiment import Experiment
from lusee_bayes.experiment.rounds import Inference
from lusee_bayes.experiment.scenario import Scenario
from lusee_bayes.experiment.unknowns import (
    PointingReport,
    UnknownsReport,
    flux_lines,
)
from lusee_bayes.flight.reduced import Reduced
from lusee_bayes.judge.chi2 import RULE
from lusee_bayes.judge.measures import effective_resolution_deg
from lusee_bayes.results.channel import ChannelResult
from lusee_bayes.results.saved import JUDGED
from lusee_bayes.systematics.beam import beam_rms_difference


def prior_sentence(experiment: Experiment) -> str:
    """The prior's model, where its C_ell comes from and, if it was learned, its parameters.

    Parameters
    ----------
    experiment : Experiment
    """
    section, learned = experiment.scenario.prior, experiment.learned
    rows = [] if learned is None else learned.as_rows()
    found = ", ".join(f"{r['name']} {r['value']:.2f} +- {r['std']:.2f}" for r in rows)
    return f"Prior {section.model}, C_ell {section.origin}{': ' if found else ''}{found}."


def joint_prior_sentence(scenario: Scenario) -> str:
    """Which prior the skies of a joint posterior have.

    Parameters
    ----------
    scenario : Scenario
        Of joint channels.
    """
    section, kept = scenario.spectral, f"prior.model={scenario.prior.model} is not used"
    if section.model == "positive":
        return (
            f"Prior spectral.model=positive: the embedded template times the exponential of "
            f"{', '.join(section.fields)}, their C_ell learned from these data; {kept}."
        )
    return f"Prior spectral.model={section.model}, C_ell of the scenario's own skies; {kept}."


@dataclass(frozen=True, repr=False)
class MapResult(Described):
    """A posterior map at one frequency: a cube of one channel, with its model at hand.

    Attributes
    ----------
    experiment : Experiment
    inference : Inference
        The model and its posterior, given all data.
    channel : ChannelResult
    diagnostics : xarray.Dataset
        What a report shows beyond the map (:func:`.diagnostics`).
    fluxes : DataFrame or None
        Of the point sources beside the map, a row each, if there are any.
    pointing : PointingReport or None
        Of clock and pointing, where the scenario has them or the data do not fit.
    unknowns : UnknownsReport or None
        Of receivers, ground and gain table, where the model has them.
    digests : tuple of str
        Of all data behind the posterior.
    seconds : dict
        By stage.
    diagnosis : Diagnosis or None
        The usual mistakes that would explain the data, where they were tried.
    reduced : Reduced or None
        Of flight data: the spectra behind them.
    """

    experiment: Experiment
    inference: Inference
    channel: ChannelResult
    diagnostics: xr.Dataset
    fluxes: pd.DataFrame | None
    pointing: PointingReport | None
    unknowns: UnknownsReport | None
    digests: tuple[str, ...]
    diagnosis: Diagnosis | None = None
    seconds: dict[str, float] = field(default_factory=dict)
    reduced: Reduced | None = None

    def description(self) -> tuple[str, ...]:
        channel = self.channel
        return (
            f"{channel.frequency_mhz:g} MHz, lmax = {self.scenario.lmax}, {channel.n_data} data",
            self.headline(),
            *wrap(self.verdict(), 100)[:2],
        )

    @property
    def scenario(self) -> Scenario:
        """The resolved scenario."""
        return self.experiment.scenario

    @property
    def channels(self) -> tuple[ChannelResult, ...]:
        """The one channel."""
        return (self.channel,)

    @property
    def band(self) -> int:
        """The number of its band among the reduced spectra."""
        return 0 if self.reduced is None else self.reduced.band(self.channel.frequency_mhz)

    def summary(self) -> dict[str, object]:
        """Figures of summary.json; null where a truth would be needed and is not known."""
        channel, learned = self.channel, self.experiment.learned
        offsets = None if self.pointing is None else self.pointing.offsets
        return {
            **_figures(channel, "frequency_mhz", "ell_cross"),
            "effective_resolution_deg": effective_resolution_deg(channel.prior_fraction),
            **_figures(channel, "log_evidence", "information_bits", "chi2", "chi2_expected"),
            "level": self.diagnostics.attrs["level"],
            "verdict": self.verdict(),
            **{name: self.diagnostics.attrs[name] for name in JUDGED},
            "diagnosis": None if self.diagnosis is None else self.diagnosis.rows(),
            "coverage": channel.coverage_rows(),
            **_figures(channel, "n_data", "n_missing"),
            "n_modes": len(channel.mean),
            "rounds": channel.rounds,
            "prior": prior_sentence(self.experiment),
            "prior_parameters": [] if learned is None else learned.as_rows(),
            # the parameters integrated out, too
            "log_evidence_learned": None if learned is None else learned.log_evidence,
            "pointing": None if offsets is None else offsets.to_dict("records"),
            "unknowns": None if self.unknowns is None else self.unknowns.summary(),
            "beam_rms_difference": beam_rms_difference(self.experiment.setup),
            "mean_refinement_sigma": channel.refinement,
            "never_observed_fraction": channel.never_observed,
            "doubts": list(channel.doubts),
            **about_run(self.seconds),
        }

    def verdict(self) -> str:
        """Whether the data fit, in sentences."""
        return str(self.diagnostics.attrs["verdict"])

    def headline(self) -> str:
        """The few figures that matter, in one line."""
        channel, parts = self.channel, []
        if channel.truth is not None:
            cross = channel.ell_cross
            parts = ["SNR > 1 at every ell" if cross is None else f"SNR < 1 first at ell {cross}"]
        resolution = effective_resolution_deg(channel.prior_fraction)
        if resolution is not None:
            parts.append(f"resolution {resolution:.1f} deg")
        parts.append(f"chi2 {channel.chi2:.0f} (expected {channel.chi2_expected:.0f})")
        parts.append(f"ln evidence {channel.log_evidence:.1f}")
        parts.append(f"{channel.information_bits:.0f} bits")
        return ", ".join(parts)

    def lines(self) -> list[str]:
        """What a terminal shows: verdict and causes first, then prior, unknowns and figures."""
        fluxes = [] if self.fluxes is None else flux_lines(self.fluxes)
        offsets = [] if self.pointing is None else self.pointing.lines()
        unknowns = [] if self.unknowns is None else self.unknowns.lines()
        told = [prior_sentence(self.experiment), *fluxes, *offsets, *unknowns]
        causes = [] if self.diagnosis is None else self.diagnosis.sentences()
        figures = [self.headline(), RULE, *self.channel.doubts, *self._flags()]
        return [self.verdict(), *causes, *told, *figures]

    def _flags(self) -> list[str]:
        """How much of flight data was flagged, and what is doubtful about them."""
        if self.reduced is None:
            return []
        fitting = self.experiment.fitting
        line = self.reduced.flag_line(self.band, 0.0 if fitting is None else fitting.share)
        return [line.capitalize(), *self.reduced.doubts(self.band), *self.reduced.notes()]


def _figures(channel: ChannelResult, *names: str) -> dict[str, Any]:
    return {name: getattr(channel, name) for name in names}
