"""Gains that are off by what their table is said to be known to."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lusee_bayes.core.errors import InputError
from lusee_bayes.instrument.flight.gain_table import LETTERS, N_COMPONENTS, GainTable
from lusee_bayes.instrument.flight.spectrometer import PORTS


def draw_gains(
    table: GainTable, gain_std: float | None, generator: np.random.Generator
) -> tuple[GainTable, dict[str, float]]:
    """Draw gains of which a table is the mean.

    With independent standard normal z for each level of each port,
    G = (1 + gain_std z_0) (mean + q_1 v_1 + q_2 v_2) + sum_r component_std_r z_r v_r.

    Parameters
    ----------
    table : GainTable
        With its ``component_std``, or None where its components are exact.
    gain_std : float or None
        Relative to the gain; None if it is exact.
    generator : numpy.random.Generator

    Returns
    -------
    table : GainTable
        The gains that are drawn, for the same telemetry.
    errors : dict
        z by the names that averages of spectra have for them, as M0 and M0 PC1.

    Raises
    ------
    InputError
        If a gain is drawn below zero.
    """
    mean, coefficient = table.mean.copy(), table.coefficient.copy()
    errors: dict[str, float] = {}
    for number, level in enumerate(LETTERS):
        for port in range(PORTS):
            name, place = f"{level}{port}", (number, port)
            if gain_std is not None:
                errors[name] = float(generator.standard_normal())
                factor = 1.0 + gain_std * errors[name]
                if factor <= 0.0:
                    raise InputError(
                        f"with a standard deviation of {gain_std:g} of itself the gain of {name} "
                        "was drawn below zero; give a smaller flight.gain_std"
                    )
                mean[place] *= factor
                coefficient[place] *= factor
            if table.component_std is not None:
                for r in range(N_COMPONENTS):
                    z = errors[f"{name} PC{r + 1}"] = float(generator.standard_normal())
                    coefficient[(*place, r, 0)] += table.component_std[(*place, r)] * z
    return replace(table, mean=mean, coefficient=coefficient), errors
