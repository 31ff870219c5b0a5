"""Fluxes of the point sources beside a map."""

from __future__ import annotations

import numpy as np
import pandas as pd

from lusee_bayes.experiment.experiment import Experiment
from lusee_bayes.experiment.rounds import Inference
from lusee_bayes.experiment.simulate import true_values
from lusee_bayes.linear.templates import template_amplitudes
from lusee_bayes.sky import kelvin_steradian
from lusee_bayes.systematics import PointSources


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
    rows, at = [], 0
    for source in sources.sources:
        true = np.broadcast_to(truth.get(source.site, np.nan), source.n_blocks)
        for block, up in enumerate(source.seen()):
            row = {
                "source": source.name,
                "block": block,
                "above_horizon": bool(up),
                "flux_jy": mean[at] * jansky,
                "std_jy": std[at] * jansky,
                "flux_k_sr": mean[at],
                "std_k_sr": std[at],
                "prior_jy": float(source.mean) * jansky,
                "prior_std_jy": float(source.std) * jansky,
            }
            rows.append(row if data.truth is None else row | {"true_jy": true[block] * jansky})
            at += 1
    return pd.DataFrame(rows)


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
