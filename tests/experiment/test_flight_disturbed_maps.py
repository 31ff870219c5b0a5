"""A map of disturbed spectra is that of the same spectra without what disturbs them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from lusee_bayes.experiment.experiment import build
from lusee_bayes.experiment.flight_data import reduce_files, visibilities_of
from lusee_bayes.experiment.inference import infer
from lusee_bayes.experiment.leave_out import without
from lusee_bayes.experiment.rounds import settled
from lusee_bayes.experiment.scenario import load_scenario
from lusee_bayes.flight.reduced import BURST, SATURATED
from lusee_bayes.runs.flight_run import run_simulate_flight

ROWS, STEP_S = 1000, 42.0
SMALL = [
    "lmax=8",
    "frequency_mhz=25",
    "noise.radiometer={form: exact, temperature: measured}",
    "flight={per_kelvin_v2_hz: 1e-21}",
    f"observation.step_s={STEP_S}",
    f"observation.runs=[{{cycles: {(ROWS + 0.5) * STEP_S / (27.321661 * 86400.0)}}}]",
]
DISTURBED = (
    "flight.simulated={tones_mhz: [24.7, 25.1], tone_share: 0.2, saturated_share: 0.02, "
    "burst_every_h: 1.5, burst_s: 900, burst_factor: 100}"
)


def spectra(folder, *more):
    """Every spectrum a sample: their noise is the same with and without disturbances."""
    made = run_simulate_flight(load_scenario("fiducial", [*SMALL, *more]), folder)
    scenario = load_scenario(str(made.scenario), ["observation.average_s=null"])
    with np.load(folder / "truth.npz") as truth:
        return scenario, reduce_files(list(made.sessions), scenario), dict(truth)


@pytest.mark.long
def test_a_map_of_disturbed_spectra_is_that_of_clean_ones(tmp_path):
    scenario, reduced, truth = spectra(tmp_path / "a", DISTURBED)
    _, clean, _ = spectra(tmp_path / "b")
    reason = reduced.reason[0]
    burst = truth["burst"] & ~truth["saturated"]
    assert min(burst.sum(), truth["saturated"].sum(), truth["tone"].sum()) > 15
    assert (reason[burst] == BURST).mean() >= 0.95
    assert (reason[truth["saturated"]] == SATURATED).all()
    assert (reason[~burst & ~truth["saturated"]] != 0).mean() <= 1e-3
    experiment = build(scenario, visibilities_of(reduced, scenario))
    found = infer(experiment).posterior
    # the clean spectra of the same times: those that are flagged are lost to both
    gone = np.ones((16, ROWS), dtype=bool)
    gone[:, reduced.bins_at(0)] = experiment.fitting.flagged
    whole = build(scenario.model_copy(update={"flight": None}), visibilities_of(clean, scenario))
    setup, data = without(whole.setup, whole.data, gone)
    same = settled(setup, data).posterior
    std = np.asarray(same.std())
    moved = np.asarray(found.mean) - np.asarray(same.mean)
    assert np.sqrt(np.mean((moved / std) ** 2)) < 0.1
    assert np.abs(moved / std).max() < 0.2
    # and what would come of it without flags
    noise = {"n_averaged": clean.n_averaged, "reason": clean.reason}
    unflagged = replace(reduced, values=reduced.before, **noise)
    spoilt = infer(
        build(scenario.model_copy(update={"flight": None}), visibilities_of(unflagged, scenario))
    ).posterior
    assert np.abs((np.asarray(spoilt.mean) - np.asarray(same.mean)) / std).max() > 5.0
