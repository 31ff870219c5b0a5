"""Receivers, ground and gain table of a map: what the data tell of each, and what they cannot."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pandas as pd
from jaxtyping import Float

from lusee_bayes.experiment.experiment import Experiment
from lusee_bayes.experiment.rounds import Inference
from lusee_bayes.experiment.simulate import true_values
from lusee_bayes.linear.templates import Amplitudes, template_amplitudes
from lusee_bayes.results.null_direction import NullDirection
from lusee_bayes.systematics import GainTable, LinearUnknowns

# what these are called beside receivers and ground
SKY, GAIN = "uniform sky", "common gain"
# what keeps so much of its prior's standard deviation is not told by the data
KEPT = 0.9


@dataclass(frozen=True)
class UnknownsReport:
    """What a map tells of receivers, ground and gain table.

    Attributes
    ----------
    table : DataFrame
        A row for each: unknown, unit, value, std, prior, prior_std and, if known, true.
    null : NullDirection
    common : float or None
        Standard deviation of what all errors of gains have in common, over its prior's; None
        without a gain table.
    onto : bool
        Whether the map is of earlier data, too, which the table is not of.
    """

    table: pd.DataFrame
    null: NullDirection
    common: float | None = None
    onto: bool = False

    def notes(self) -> list[str]:
        """What has to be known to read the table, a sentence each."""
        found = []
        if self.common is not None and self.common > KEPT:
            found.append(
                "The common gain of all ports keeps its prior (standard deviation "
                f"{self.common:.2f} of the prior's): no sky of unknown brightness tells it."
            )
        if self.onto:
            found.append(
                "Receivers, ground and gains are what the new data alone tell of them; those of "
                "the earlier data are in the folder that the map was made onto."
            )
        return found

    def lines(self) -> list[str]:
        """One line for every unknown, the sentence of the null direction, and the notes."""
        lines = []
        for row in self.table.to_dict("records"):
            unit = f" {row['unit']}" if row["unit"] else ""
            text = f"{row['unknown']}: {row['value']:.4g} +- {row['std']:.2g}{unit}"
            if row["std"] > KEPT * row["prior_std"]:
                text += f", the prior's {row['prior_std']:.2g}: these data do not tell it"
            lines.append(text)
        sentence = self.null.sentence()
        return [*lines, *([sentence] if sentence else []), *self.notes()]

    def summary(self) -> dict[str, object]:
        """Entry of summary.json."""
        parts = dict(zip(self.null.names, self.null.weights.tolist(), strict=True))
        return {
            "rows": self.table.to_dict("records"),
            "null_direction": parts,
            "null_share": self.null.share,
            "null_sentence": self.null.sentence(),
            "common_gain_std_share": self.common,
            "notes": self.notes(),
        }


def unknowns_report(experiment: Experiment, found: Inference) -> UnknownsReport | None:
    """Work out what the data tell of receivers, ground and gain table.

    Parameters
    ----------
    experiment : Experiment
    found : Inference
        Of these data alone.

    Returns
    -------
    UnknownsReport or None
        None if the model has no such unknowns.
    """
    listed = [s for s in found.systematics if isinstance(s, (LinearUnknowns, GainTable))]
    if not listed:
        return None
    columns = np.concatenate([np.asarray(s.columns) for s in listed], axis=1)
    told = template_amplitudes(found.model, found.posterior, experiment.data.data, columns)
    # of spectra, the sky behind them may be known, but not what the scenario would have drawn
    simulated = experiment.data.truth is not None and experiment.data.calibration is None
    truth = true_values(experiment.setup) if simulated else None
    rows, at = [], 0
    for systematic in listed:
        stds = np.asarray(systematic.stds)
        own = slice(at, at + len(stds))
        value = systematic.in_units(systematic.expected + told.mean[own])
        prior = systematic.in_units(0.0 * stds)
        true = None if truth is None else systematic.true(truth)
        for name, std, prior_std in zip(value, told.std[own] * stds, stds, strict=True):
            row = {
                "unknown": name,
                "unit": systematic.unit,
                "value": value[name],
                "std": float(std),
                "prior": prior[name],
                "prior_std": float(prior_std),
            }
            rows.append(row if true is None else row | {"true": true[name]})
        at += len(stds)
    parts = _named_parts(told, listed)
    common = None
    if GAIN in parts:
        common = float(np.sqrt((parts[GAIN] @ told.covariance @ parts[GAIN].T).item()))
    null = _null_direction(found, told, parts)
    return UnknownsReport(pd.DataFrame(rows), null, common)


def _named_parts(
    told: Amplitudes, listed: list[LinearUnknowns | GainTable]
) -> dict[str, Float[np.ndarray, "1 templates"]]:
    """Directions of powers and temperatures, and of what all errors of gains have in common.

    Of the latter one unit vector, since those of single ports and levels look like no sky.
    """
    parts, at = {}, 0
    for systematic in listed:
        n = len(systematic.names)
        own = np.eye(len(told.mean))[at : at + n]
        if isinstance(systematic, GainTable):
            parts[GAIN] = systematic.common[None] @ own
        else:
            parts |= {label: own[k : k + 1] for k, label in enumerate(systematic.labels)}
        at += n
    return parts


def _null_direction(
    found: Inference, told: Amplitudes, parts: dict[str, Float[np.ndarray, "1 templates"]]
) -> NullDirection:
    """That of the monopole and these parts."""
    along = np.concatenate(list(parts.values()))
    sky_std = float(np.sqrt(np.asarray(found.model.prior.variance())[0]))
    sky = np.asarray(found.posterior.std())[0] / sky_std
    mixed = along @ told.with_sky[0] / sky_std
    inner = along @ told.covariance @ along.T
    names = (SKY, *parts)
    return NullDirection.of(names, np.block([[sky**2, mixed[None]], [mixed[:, None], inner]]))
