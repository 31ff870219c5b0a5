"""Curves of gains over frequency, for figures."""

from __future__ import annotations

import numpy as np

from lusee_bayes.instrument.flight.gain_table import LETTERS
from lusee_bayes.instrument.flight.recipe import Recipe
from lusee_bayes.instrument.flight.reduced import Curves
from lusee_bayes.instrument.flight.spectrometer import PORTS
from lusee_bayes.instrument.flight.timeline import Timeline

# first and last frequency, and how many
CURVE_MHZ = (0.5, 51.0, 203)


def gain_curves(line: Timeline, recipe: Recipe) -> Curves:
    """Return the gains of every level of every port that some spectrum has.

    Parameters
    ----------
    line : Timeline
    recipe : Recipe
    """
    mhz = np.linspace(*CURVE_MHZ)
    shape = (len(LETTERS), PORTS, len(mhz))
    gain, std = np.full(shape, np.nan), np.zeros(shape)
    levels = np.concatenate([s.level for s in line.sessions])
    telemetry = {
        name: np.array([np.concatenate([s.telemetry[name] for s in line.sessions]).mean()])
        for name in line.sessions[0].telemetry
    }
    table = recipe.table
    for number, level in enumerate(LETTERS):
        for port in np.flatnonzero((levels == level).any(axis=0)).tolist():
            basis = table.basis(level, port, mhz)
            strengths = table.strengths(level, port, telemetry)[0]
            gain[number, port] = basis[0] + strengths @ basis[1:]
            variance = (0.0 if recipe.gain_std is None else recipe.gain_std) ** 2 * np.square(
                gain[number, port]
            )
            if table.component_std is not None:
                variance = variance + np.square(
                    table.component_std[number, port][:, None] * basis[1:]
                ).sum(axis=0)
            std[number, port] = np.sqrt(variance)
    return Curves(mhz, gain, std)
