"""Receivers, ground and gain table of a map: what the data tell of each, and what they cannot."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pandas as pd

from lusee_bayes.experiment.experiment import Experiment
from lusee_bayes.experiment.rounds import Inference
from lusee_bayes.experiment.simulate import true_values
from lusee_bayes.linear.templates import Amplitudes, template_amplitudes
from lusee_bayes.results.null_direction import NullDirection
from lusee_bayes.systematics import GainTable, LinearUnknowns

# what these are called beside receivers and ground
SKY, GAIN = "uniform sky", "common gain"


@dataclass(frozen=True)
class UnknownsReport:
    """What a map tells of receivers, ground and gain table.

    Attributes
    ----------
    table : DataFrame
        A row for each: unknown, unit, value, std, prior, prior_std and, if known, true.
    null : NullDirection
    """

    table: pd.DataFrame
    null: NullDirection

    def lines(self) -> list[str]:
        """One line for every unknown, and the sentence of the null direction."""
        lines = []
        for row in self.table.to_dict("records"):
            unit = f" {row['unit']}" if row["unit"] else ""
            text = f"{row['unknown']}: {row['value']:.4g} +- {row['std']:.2g}{unit}"
            if row["std"] > 0.9 * row["prior_std"]:
                text += f", the prior's {row['prior_std']:.2g}: these data do not tell it"
            lines.append(text)
        sentence = self.null.sentence()
        return [*lines, sentence] if sentence else lines

    def summary(self) -> dict[str, object]:
        """Entry of summary.json."""
        parts = dict(zip(self.null.names, self.null.weights.tolist(), strict=True))
        return {
            "rows": self.table.to_dict("records"),
            "null_direction": parts,
            "null_share": self.null.share,
            "null_sentence": self.null.sentence(),
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
    return UnknownsReport(pd.DataFrame(rows), _null_direction(found, told, listed))


def _null_direction(
    found: Inference, told: Amplitudes, listed: list[LinearUnknowns | GainTable]
) -> NullDirection:
    """That of the monopole, powers and temperatures, and what all errors of gains have in common.

    Of the latter one unit vector, since those of single ports and levels look like no sky.
    """
    names, weights, at = [SKY], [], 0
    for systematic in listed:
        n = len(systematic.names)
        own = np.eye(len(told.mean))[at : at + n]
        if isinstance(systematic, GainTable):
            names.append(GAIN)
            weights.append(systematic.common[None] @ own)
        else:
            names.extend(systematic.labels)
            weights.append(own)
        at += n
    parts = np.concatenate(weights)
    sky_std = float(np.sqrt(np.asarray(found.model.prior.variance())[0]))
    sky = np.asarray(found.posterior.std())[0] / sky_std
    mixed = parts @ told.with_sky[0] / sky_std
    inner = parts @ told.covariance @ parts.T
    return NullDirection.of(names, np.block([[sky**2, mixed[None]], [mixed[:, None], inner]]))
