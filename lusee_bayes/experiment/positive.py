"""The skies of a scenario whose channels share fields of the logarithm, and how fine these are."""

from __future__ import annotations

import numpy as np

from lusee_bayes.core.errors import InputError
from lusee_bayes.core.harmonics import n_modes
from lusee_bayes.experiment.scenario import Scenario
from lusee_bayes.sky.galaxy import BRIGHT_SOURCES, galactic_share
from lusee_bayes.sky.positive_skies import PositiveSkies
from lusee_bayes.sky.sky_source import EmbeddedTemplate

# highest ell of the fields, over that of the map
FIELDS = 1.5
# most fields' modes: every round factorises their matrix
MOST_UNKNOWNS = 10_000


def lmax_of_fields(scenario: Scenario, lmax: int | None = None) -> int:
    """Choose the highest ell of the fields: 1.5 times that of the map, if they can be solved for.

    Structure that a map does not resolve still changes it where the sky is steep.

    Parameters
    ----------
    scenario : Scenario
        Of positive joint skies.
    lmax : int, optional
        Of the map; by default the scenario's.

    Raises
    ------
    InputError
        If fields of the map's own lmax are too many unknowns.
    """
    lmax = scenario.lmax if lmax is None else lmax
    n_fields = len(scenario.spectral.fields)
    highest = int(np.sqrt(MOST_UNKNOWNS / n_fields)) - 1
    if highest < lmax:
        raise InputError(
            f"positive joint skies of lmax {lmax} have {n_fields * n_modes(lmax)} unknowns, more "
            f"than the {MOST_UNKNOWNS} of one solution; use lmax={highest}, fewer "
            "spectral.fields, or spectral.model=components"
        )
    return min(round(FIELDS * lmax), highest)


def positive_skies(scenario: Scenario) -> PositiveSkies:
    """The skies of a scenario's channels as functions of the fields.

    Parameters
    ----------
    scenario : Scenario
        Of positive joint skies.

    Raises
    ------
    InputError
        As :func:`lmax_of_fields`.
    """
    section, frequencies, lmax = scenario.spectral, scenario.frequencies_mhz, scenario.lmax
    sources = None
    if section.sources:
        sources = np.array([[s.modes(f, lmax) for s in BRIGHT_SOURCES] for f in frequencies])
    return PositiveSkies.of(
        np.array(frequencies),
        [EmbeddedTemplate(f) for f in frequencies],
        lmax,
        section.fields,
        reference_mhz=section.reference_mhz,
        turnover_mhz=section.turnover_mhz,
        sources=sources,
        weight=galactic_share,
        lmax_fields=lmax_of_fields(scenario),
    )
