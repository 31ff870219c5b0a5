"""What a map leaves out, and which errors of the instrument it would not show."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from experiments import rms_of_directions

import lusee_bayes as lb
from lusee_bayes.experiment import rounds, validity
from lusee_bayes.experiment.model import base_model, moved, set_up
from lusee_bayes.systematics.context import Around

ISOTROPIC = "prior={model: isotropic}"


def scenario_of(*overrides, lmax, step_s):
    size = [f"lmax={lmax}", f"observation.step_s={step_s}"]
    return lb.load_scenario("fiducial", [*size, *overrides])


@pytest.fixture(scope="module")
def plain():
    experiment = lb.build(scenario_of(ISOTROPIC, lmax=6, step_s=43200.0))
    return experiment, lb.infer(experiment)


@pytest.fixture(scope="module")
def spots(plain):
    experiment, found = plain
    made = validity.blind_spots(experiment.setup, found, found.posterior.mean)
    return {spot.name: spot for spot in made}


ERRORS = [("surface_permittivity", 3.7, 0.037), ("tilt_north_deg", 0.0, 0.1)]


def check_effect(plain, spot, more, rel, rel_shown):
    """The spot's bias and rise of chi^2 are those of the change ``more`` of the data."""
    experiment, found = plain
    d, sky = np.asarray(experiment.data.data), found.posterior.mean
    shift = found.model.condition(d + more).posterior.mean - found.model.condition(d).posterior.mean
    c = np.asarray(found.posterior.covariance())
    bias = np.sqrt(shift @ np.linalg.solve(c, shift) / len(sky))
    std = np.sqrt(np.asarray(found.model.noise.diagonal()))
    a, white = np.asarray(found.model.coupling.dense()) / std[:, None], more / std
    left = white - a @ np.linalg.lstsq(a, white, rcond=None)[0]
    shown = left @ left / np.sqrt(2.0 * (len(d) - len(sky)))
    assert spot.bias == pytest.approx(bias, rel=rel)
    assert spot.shown == pytest.approx(shown, rel=rel_shown)


@pytest.mark.parametrize(("name", "centre", "size"), ERRORS)
def test_what_an_error_does_is_what_it_does_to_data(plain, spots, name, centre, size):
    """Data with the error in them, mapped without it; chi^2 of what no sky of any size explains.

    A tenth of it, of both signs, is linear to 1e-3; a prior
    100 times as wide is none to 1e-4 of what the data determine, and to 1 % of what they hardly do.
    """
    section = {"surface_permittivity": "beam={parameters: {surface_permittivity: 0.1}}"}
    term = "noise." + section.get(name, "pointing={tilt_north_deg: 1}")
    scenario = scenario_of(ISOTROPIC, term, lmax=6, step_s=43200.0)
    steps, sky = (size / 10.0, -size / 10.0), plain[1].posterior.mean
    above, below = (moved(set_up(scenario), {name: centre + step}) for step in steps)
    more = 5.0 * (np.asarray(above.coupling @ sky) - np.asarray(below.coupling @ sky))
    check_effect(plain, spots[name], more, 1e-3, 0.05)


def test_terrain_that_nothing_reveals(plain, spots, tmp_path):
    """On one side, of the altitude that just is not seen: the cube holds to a fifth."""
    azimuth, spot = np.arange(360.0), spots["horizon_deg"]
    altitude = spot.size * (1.0 + np.cos(np.radians(azimuth))) / 2.0
    table = pd.DataFrame({"azimuth_deg": azimuth, "altitude_deg": altitude})
    table.to_csv(tmp_path / "terrain.csv", index=False)
    terrain = f"noise.horizon={{file: {tmp_path / 'terrain.csv'}, std_deg: 1, treatment: ignored}}"
    setup = set_up(scenario_of(ISOTROPIC, terrain, lmax=6, step_s=43200.0))
    (experiment, found), seen = plain, setup.coupling @ plain[1].posterior.mean
    more = np.asarray(seen - experiment.setup.coupling @ found.posterior.mean)
    check_effect(plain, spot, more, 0.2, 0.4)


def test_a_clock_that_is_off_turns_the_sky_alone(spots):
    """No residual shows it, however far it moves the map."""
    one = spots["clock_s"]
    assert one.bias > 5.0 and one.shown < validity.NOTHING * one.bias**2


def test_what_is_an_unknown_is_no_blind_spot():
    given = "noise.beam={parameters: {surface_permittivity: 0.1}}", "noise.fields={lmax: 1}"
    setup = set_up(scenario_of(ISOTROPIC, *given, lmax=4, step_s=86400.0))
    model, held = rounds.model_about(setup, Around())
    found = rounds.Inference(model.condition(np.zeros(model.n_data)), held, 1, Around())
    names = [one.name for one in validity.blind_spots(setup, found, setup.sky.modes)]
    assert "deep_permittivity" in names
    assert not {"surface_permittivity", validity.FIELDS_NAME} & set(names)


def test_the_sentence_names_what_moves_the_map_and_is_not_seen():
    spots = [
        validity.BlindSpot("a", 1.0, " %", 40.0, 0.1),
        validity.BlindSpot("b", 0.1, "", 90.0, 5.0),
        validity.BlindSpot("c", 0.1, "", 0.1, 0.1),
    ]
    text = validity.blind_sentence(spots)
    assert "a by 1 % (40)" in text and " b by" not in text and " c by" not in text
    assert not validity.blind_sentence(spots[1:])
    size, bias = spots[1].unnoticed
    assert size == pytest.approx(0.1 * np.sqrt(0.6)) and bias == pytest.approx(90 * np.sqrt(0.6))


@pytest.mark.essential
def test_the_gaussian_serves_where_values_were_found_and_not_far_from_them(monkeypatch):
    beam = "noise.beam={parameters: {surface_permittivity: 0.2, zenith_angle_deg: 1}}"
    runs = "observation.runs=[{cycles: 1}, {cycles: 1, turntable_deg: 30}]"
    experiment = lb.build(scenario_of(ISOTROPIC, beam, runs, lmax=5, step_s=43200.0))
    found, setup, d = lb.infer(experiment), experiment.setup, np.asarray(experiment.data.data)
    k, moved_by = validity.weighed(setup, d, found)
    assert k < validity.LARGEST_K and moved_by < 0.1 * validity.LARGEST_MOVE
    assert validity.reach(experiment, found) == ([], [])
    # about the prior's means, two standard deviations off, the first order is far from the model
    model, held = rounds.model_about(setup, Around(experiment.data))
    first = rounds.Inference(model.condition(d), held, 1, Around(experiment.data))
    k, moved_by = validity.weighed(setup, d, first)
    # the map there is wrong by as much as it moves when N is built about what was found
    wrong = rms_of_directions(first, found.posterior.mean)
    assert k > validity.LARGEST_K and wrong / 3.0 < moved_by < 3.0 * wrong
    assert "errors do not hold" in validity.reach(experiment, first)[0][0]
    # a few draws may miss where the Gaussian is wrong: even weights are not sufficient
    monkeypatch.setattr(validity, "weighed", lambda *_: (0.1, 2.0 * validity.LARGEST_MOVE))
    assert "errors do not hold" in validity.reach(experiment, found, alone=False)[0][0]
    # errors that hold are no doubt, and of several channels such ones say nothing
    monkeypatch.setattr(validity, "weighed", lambda *_: (np.inf, 0.1))
    doubts, (note,) = validity.reach(experiment, found)
    assert not doubts and "errors hold" in note
    assert validity.reach(experiment, found, alone=False) == ([], [])


OFFSETS = (
    "turntable_deg: 1, tilt_east_deg: 1, tilt_north_deg: 1, lat_deg: 1, lon_deg: 1, clock_s: 60"
)


@pytest.mark.essential
@pytest.mark.parametrize("seed", [1, 2])
def test_turns_that_the_sky_can_follow_are_in_n_to_second_order(seed):
    """The distance is that of 81 modes, 1 +- 0.08, and third order; to first order, 220 and 59."""
    offsets = f"noise.pointing={{{OFFSETS}}}"
    experiment = lb.build(scenario_of(offsets, f"seed={seed}", lmax=8, step_s=21600.0))
    found, truth = lb.infer(experiment), experiment.setup.sky.modes
    first = rms_of_directions(rounds.settled(experiment.setup, Around(experiment.data)), truth)
    assert 0.75 < rms_of_directions(found, truth) < 1.3 < 0.1 * first
    doubts, notes = validity.reach(experiment, found)
    assert not doubts and "the second order of noise.pointing" in notes[0]


@pytest.mark.essential
def test_two_orientations_that_fit_are_named():
    """The true one is the other: 3.0 degrees and a lean of -0.7; the map is far from the sky."""
    offsets = "noise.pointing={turntable_deg: 1, tilt_east_deg: 1}"
    given = "frequency_mhz=20", "prior={model: isotropic, spectrum: sky}", "seed=6"
    experiment = lb.build(scenario_of(offsets, *given, lmax=5, step_s=21600.0))
    found, truth = lb.infer(experiment), experiment.setup.sky.modes
    assert found.fits and rms_of_directions(found, truth) > 100.0
    assert "fit as well with turntable_deg = 3, tilt_east_deg = -0.7" in found.unsettled


def test_nothing_is_weighed_where_nothing_was_found_in_rounds(plain):
    experiment, found = plain
    assert validity.weighed(experiment.setup, np.asarray(experiment.data.data), found) is None
    measured = replace(experiment, setup=replace(experiment.setup, measured=True))
    assert "would not reveal" in validity.reach(measured, found)[1][0]
    assert base_model(experiment.setup).n_data == found.model.n_data
