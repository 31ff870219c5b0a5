"""Visibilities of a scenario's sky at the inputs of the receivers, at the times of spectra."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from lusee_bayes.core.errors import InputError
from lusee_bayes.core.progress import Stages
from lusee_bayes.experiment.flight_data import per_kelvin_of
from lusee_bayes.experiment.scenario import Scenario
from lusee_bayes.experiment.setup import set_up
from lusee_bayes.experiment.simulate import true_signal, true_values
from lusee_bayes.instrument.layout import DataLayout
from lusee_bayes.instrument.observation import Observation
from lusee_bayes.instrument.products import all_products
from lusee_bayes.instrument.visibilities import Visibilities
from lusee_bayes.instrument.windows import Windows

# spectra whose A is in memory at once
PIECE = 2048
PRODUCTS = all_products()


def spectra_observation(scenario: Scenario, window_s: float) -> Observation:
    """Return the scenario's observation, with windows as long as a spectrum.

    Parameters
    ----------
    scenario : Scenario
    window_s : float
        Length of each, in seconds, about the middle of the sample.

    Raises
    ------
    InputError
        If the axis of the Moon is fixed, no sample lasts for so long, or the turntable turns:
        sessions do not say its angle.
    """
    if scenario.observation.fixed_axis:
        raise InputError(
            "spectra are means over the time of their integration, and observation.fixed_axis is "
            "for instants; leave it out"
        )
    # whatever the samples of other data would be
    planned = scenario.observation.model_copy(update={"window": "mean"}).observation()
    bounds, live = planned.windows.bounds_s, planned.windows.live_per_sample_s
    whole = live > (bounds[:, 1] - bounds[:, 0]) * (1.0 - 1e-9)
    half = window_s / 2.0
    long = whole & (bounds[:, 0] <= -half + 1e-6) & (bounds[:, 1] >= half - 1e-6)
    if not long.any():
        raise InputError(
            f"no sample of the observation is live for the {window_s:.6g} s of a spectrum; check "
            "observation.schedule and observation.step_s"
        )
    observation = planned.select(long)
    if len(set(observation.turntable_deg)) > 1:
        raise InputError(
            "the turntable turns within the observation, and sessions do not say its angle; "
            "simulate the stretch of each angle on its own (observation.runs)"
        )
    edges = np.full(observation.n_times, half)
    return replace(observation, windows=Windows.whole(-edges, edges))


def true_visibilities(
    scenario: Scenario, observation: Observation, stages: Stages
) -> Float[np.ndarray, "frequencies products times"]:
    """Return visibilities of the scenario's sky with the true instrument, in V^2/Hz.

    Errors of the gain table are none of the instrument's: they are in the counts.

    Parameters
    ----------
    scenario : Scenario
        Of one frequency, or several.
    observation : Observation
    stages : Stages
        Told how far it is.

    Raises
    ------
    InputError
        If the beams know no volts.
    """
    known = scenario.noise.model_copy(update={"gain_table": None})
    scenario = scenario.model_copy(update={"noise": known})
    channels = scenario.channels() or (scenario,)
    scales = [_scale(channel) for channel in channels]
    # what changes with time has to be drawn for all of it
    noise = scenario.noise
    whole = noise.gain is not None or noise.pointing is not None or bool(scenario.sources.list)
    n = observation.n_times
    piece = n if whole else PIECE
    found = np.empty((len(channels), len(PRODUCTS), n))
    with stages.progress("visibilities", n * len(channels)) as done:
        for start in range(0, n, piece):
            here = np.zeros(n, dtype=bool)
            here[start : start + piece] = True
            part = observation.select(here)
            for number, (channel, scale) in enumerate(zip(channels, scales, strict=True)):
                found[number, :, here] = (scale[:, None] * _kelvin(channel, part)).T
                done(start * len(channels) + (number + 1) * part.n_times)
    return found


def _scale(scenario: Scenario) -> Float[np.ndarray, " products"]:
    """V^2/Hz for 1 K in each product."""
    per_kelvin = per_kelvin_of(scenario)
    return np.sqrt([per_kelvin[p.i] * per_kelvin[p.j] for p in PRODUCTS])


def _kelvin(scenario: Scenario, observation: Observation) -> Float[np.ndarray, "products times"]:
    layout = DataLayout.from_flags(np.zeros((len(PRODUCTS), observation.n_times), dtype=bool))
    nothing = Visibilities(np.zeros(layout.size), layout, observation, scenario.frequency_mhz)
    setup = set_up(scenario, nothing)
    return np.asarray(true_signal(setup, true_values(setup)))
