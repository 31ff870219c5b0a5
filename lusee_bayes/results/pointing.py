"""Clock and pointing of a map: what the data tell of their offsets, and which each day prefers."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pandas as pd
from jaxtyping import Float

from lusee_bayes.experiment.experiment import Experiment
from lusee_bayes.experiment.model import radiometer
from lusee_bayes.experiment.rounds import Inference, offset_posterior
from lusee_bayes.experiment.simulate import true_values
from lusee_bayes.experiment.terms import offsets_about, second_order
from lusee_bayes.instrument.pointing_offsets import offset_names
from lusee_bayes.linear.offset_tests import preferences
from lusee_bayes.linear.residuals import HOURS_A_DAY

# offsets that are tested whatever the scenario says, and how far apart the two sides of their
# derivative are; longitude and latitude do what clock and lean do
TESTED = {"clock_s": 10.0, "turntable_deg": 0.1, "tilt_east_deg": 0.1, "tilt_north_deg": 0.1}
# more days than that are taken together in groups of equal length
MOST_STRETCHES = 31
# what is left beyond first order may be that much of the radiometer noise, rms
NEGLIGIBLE = 0.1


@dataclass(frozen=True)
class PointingReport:
    """What a map tells of clock and pointing.

    Attributes
    ----------
    offsets : DataFrame or None
        A row for each offset that the model has: value, std, prior_std, beyond_first_order (rms,
        in radiometer noise) and, if known, true. None if it has none.
    preferred : DataFrame
        What the data prefer besides, of each offset for all days and for each: a row with offset,
        first_day and last_day (-1 for all), value, std and chi2_gain.
    """

    offsets: pd.DataFrame | None
    preferred: pd.DataFrame

    def lines(self) -> list[str]:
        """One line for every offset."""
        if self.offsets is None:
            return []
        lines = []
        for row in self.offsets.to_dict("records"):
            text = f"{row['offset']}: {row['value']:.4g} +- {row['std']:.2g}"
            if row["std"] > 0.9 * row["prior_std"]:
                text += f", the prior's {row['prior_std']:.2g}: these data do not tell it"
            left = row["beyond_first_order"]
            text += f"; beyond first order {left:.1g} of the noise"
            if left > NEGLIGIBLE:
                text += ", too much: set noise.pointing.treatment=sampled"
            lines.append(text)
        return lines


def pointing_report(
    experiment: Experiment, found: Inference, covariance: Float[np.ndarray, "modes modes"]
) -> PointingReport:
    """Work out the offsets of the model, and those that the data prefer besides.

    Parameters
    ----------
    experiment : Experiment
    found : Inference
        Of these data alone.
    covariance : (modes, modes) array
        Of the posterior, in K^2.
    """
    sky = np.asarray(found.posterior.mean)
    table = None if found.offsets is None else _table(experiment, found, sky)
    values = {} if table is None else dict(zip(table["offset"], table["value"], strict=True))
    return PointingReport(table, _preferred(experiment, found, covariance, sky, values))


def _table(
    experiment: Experiment, found: Inference, sky: Float[np.ndarray, " modes"]
) -> pd.DataFrame:
    mean, covariance = offset_posterior(found)
    std = dict(zip(mean, np.sqrt(np.diagonal(covariance)).tolist(), strict=True))
    prior = found.offsets.in_units(np.ones(len(mean)))
    # where values and sky are those that the data tell, only what is left of the offsets counts
    about = prior if found.around.sky is None else std
    noise = np.sqrt(np.asarray(radiometer(experiment.setup).diagonal()))
    left = second_order(experiment.setup, about, sky)
    truth = true_values(experiment.setup) if experiment.data.truth is not None else {}
    rows = []
    for name in mean:
        row = {
            "offset": name,
            "value": mean[name],
            "std": std[name],
            "prior_std": prior[name],
            "beyond_first_order": float(np.sqrt(np.mean((left[name] / noise) ** 2))),
        }
        rows.append(row | {"true": truth[name]} if truth else row)
    return pd.DataFrame(rows)


def _preferred(
    experiment: Experiment,
    found: Inference,
    covariance: Float[np.ndarray, "modes modes"],
    sky: Float[np.ndarray, " modes"],
    values: dict[str, float],
) -> pd.DataFrame:
    setup, data = experiment.setup, experiment.data
    steps = {
        name: step
        for kind, step in TESTED.items()
        for name in offset_names((kind,), setup.observation.n_runs)
    }
    centre = dict.fromkeys(steps, 0.0) | values
    offsets = offsets_about(setup, steps, sky, centre)
    per_unit = offsets.templates / np.asarray(offsets.stds)
    day = np.floor(setup.observation.hours / HOURS_A_DAY).astype(int)
    length = -(-(int(day.max()) + 1) // MOST_STRETCHES)
    stretches = np.unique(day // length)
    rows, columns = [], []
    for number, name in enumerate(steps):
        template = per_unit[:, number]
        rows.append({"offset": name, "first_day": -1, "last_day": -1})
        columns.append(template)
        for stretch in stretches.tolist():
            column = np.where((day // length == stretch)[data.layout.time], template, 0.0)
            if column.any():
                first = stretch * length
                rows.append({"offset": name, "first_day": first, "last_day": first + length - 1})
                columns.append(column)
    told = preferences(
        found.model, found.posterior, covariance, data.data, np.stack(columns, axis=1)
    )
    table = pd.DataFrame(rows)
    return table.assign(value=told.amplitude, std=told.std, chi2_gain=told.gain)
