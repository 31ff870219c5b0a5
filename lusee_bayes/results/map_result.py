"""A posterior map at one frequency, with what is needed to judge it.

Beside the map are the fluxes of point sources, and where its prior comes from.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from textwrap import wrap
from typing import Any

import jax
import numpy as np
import pandas as pd
import xarray as xr

from lusee_bayes.core.arrays import on_host
from lusee_bayes.core.checks import Described
from lusee_bayes.core.errors import InputError
from lusee_bayes.core.progress import Stages, about_run
from lusee_bayes.experiment.diagnosis import Diagnosis, diagnose
from lusee_bayes.experiment.experiment import Experiment, explained, infer
from lusee_bayes.experiment.instrument_terms import beam_rms_difference
from lusee_bayes.experiment.model import true_values
from lusee_bayes.experiment.rounds import Inference
from lusee_bayes.experiment.scenario import Scenario
from lusee_bayes.flight.reduced import Reduced
from lusee_bayes.judge.chi2 import LEVELS, RULE
from lusee_bayes.judge.measures import effective_resolution_deg
from lusee_bayes.judge.residuals import residuals
from lusee_bayes.linear.amplitudes import template_amplitudes
from lusee_bayes.linear.linear_gaussian import composed, deviation_model
from lusee_bayes.results.channel import ChannelResult, channel_of_posterior
from lusee_bayes.results.diagnostics import diagnostics
from lusee_bayes.results.saved import JUDGED
from lusee_bayes.results.unknowns import (
    PointingReport,
    UnknownsReport,
    pointing_report,
    unknowns_report,
)
from lusee_bayes.results.updatable import Updatable, read_updatable
from lusee_bayes.sky.galaxy import kelvin_steradian
from lusee_bayes.systematics.sky_unknowns import PointSources


def flux_table(experiment: Experiment, inference: Inference) -> pd.DataFrame:
    """Posterior of every source's flux in Jy and in K sr, with its prior and, if known, its truth.

    Parameters
    ----------
    experiment : Experiment
        With sources that are not ignored.
    inference : Inference
        Of these data alone.

    Returns
    -------
    DataFrame
        A row for each source, or block of it. ``above_horizon``: whether it is ever up; if not,
        its flux is known from the prior only.
    """
    setup, data = experiment.setup, experiment.data
    sources = next(s for s in inference.systematics if isinstance(s, PointSources))
    amplitudes = template_amplitudes(
        inference.model, inference.posterior, data.data, sources.templates()
    )
    prior_std = np.asarray(sources.std())
    mean = np.asarray(sources.mean()) + prior_std * amplitudes.mean
    std = prior_std * amplitudes.std
    jansky = 1.0 / kelvin_steradian(1.0, experiment.scenario.frequency_mhz)
    truth = true_values(setup) if data.truth is not None else {}
    listed = [(s, block) for s in sources.sources for block in range(s.n_blocks)]
    table = pd.DataFrame(
        {
            "source": [source.name for source, _ in listed],
            "block": [block for _, block in listed],
            "above_horizon": [bool(up) for s in sources.sources for up in s.seen()],
            "flux_jy": mean * jansky,
            "std_jy": std * jansky,
            "flux_k_sr": mean,
            "std_k_sr": std,
            "prior_jy": [float(source.mean) * jansky for source, _ in listed],
            "prior_std_jy": [float(source.std) * jansky for source, _ in listed],
        }
    )
    if data.truth is None:
        return table
    true = [np.broadcast_to(truth.get(s.site, np.nan), s.n_blocks) for s in sources.sources]
    return table.assign(true_jy=np.concatenate(true) * jansky)


def flux_lines(fluxes: pd.DataFrame) -> list[str]:
    """One line for every source, or block of it."""
    lines = []
    for row in fluxes.to_dict("records"):
        name = row["source"] if row["block"] == 0 else f"{row['source']} ({row['block']})"
        text = f"{name}: {row['flux_jy']:.4g} +- {row['std_jy']:.2g} Jy"
        if not row["above_horizon"]:
            text += ", the prior's: it is never above the horizon"
        lines.append(text)
    return lines


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


DOES_NOT_FIT = LEVELS[-1]


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


def map_result(
    experiment: Experiment,
    *,
    onto: str | Path | None = None,
    diagnosed: bool = False,
    stages: Stages | None = None,
) -> MapResult:
    """Condition an experiment's model on its data, and work out the uncertainties.

    Parameters
    ----------
    experiment : Experiment
    onto : path, optional
        Folder of an updatable run, to whose data these are added.
    diagnosed : bool
        Try the usual mistakes even if the data fit.
    stages : Stages, optional
        Told what is being done.

    Raises
    ------
    InputError
        For data that the earlier run holds already, and as :func:`infer`.
    """
    stages = stages or Stages()
    scenario, data = experiment.scenario, experiment.data
    earlier = None if onto is None else read_updatable(onto, scenario)
    digests = (data.digest(),)
    with stages("posterior"), explained(experiment):
        found = judged = alone = infer(experiment)
        if earlier is not None:
            found, judged = _updated(earlier, found, experiment)
            digests = (*earlier.digests, *digests)
        elif scenario.output.updatable:
            posterior = found.model.condition(data.data, form="root")
            found = judged = replace(found, posterior=posterior)
        jax.block_until_ready(found.posterior.white_mean)
    with stages("standard deviations"):
        covariance = on_host(found.posterior).covariance()
        channel = channel_of_posterior(
            experiment, found, covariance, n_draws=scenario.output.draws, judged=judged
        )
    fluxes = None
    if experiment.setup.responses and scenario.sources.treatment != "ignored":
        with stages("fluxes"):
            fluxes = flux_table(experiment, alone)
    unknowns = unknowns_report(experiment, alone)
    if unknowns is not None and earlier is not None:
        unknowns = replace(unknowns, onto=True)
    with stages("diagnostics"):
        left = residuals(judged.model, judged.posterior, data, channel.chi2_model)
        page = diagnostics(experiment, found, left, channel, covariance)
    pointing, diagnosis = None, None
    if diagnosed or page.attrs["level"] == DOES_NOT_FIT:
        with stages("usual mistakes"):
            diagnosis = diagnose(experiment, alone, left)
    if scenario.noise.pointing is not None or page.attrs["level"] == DOES_NOT_FIT:
        with stages("clock and pointing"):
            own = covariance if earlier is None else on_host(alone.posterior).covariance()
            pointing = pointing_report(experiment, alone, own)
    return MapResult(
        experiment,
        found,
        channel,
        page,
        fluxes,
        pointing,
        unknowns,
        digests,
        diagnosis,
        stages.seconds,
    )


def _updated(
    earlier: Updatable, alone: Inference, experiment: Experiment
) -> tuple[Inference, Inference]:
    """The posterior given earlier data and these, and the model of these given the earlier ones."""
    data = experiment.data
    if data.digest() in earlier.digests:
        raise InputError(
            "these data are behind the earlier posterior already; used again, they would count "
            "twice"
        )
    deviations = deviation_model(earlier.posterior, alone.model)
    deviation = deviations.condition(data.data, form="root")
    posterior = composed(earlier.posterior, deviation)
    return (
        replace(alone, posterior=posterior),
        Inference(deviations, alone.systematics, deviation, alone.rounds, alone.around),
    )
