"""Terrain that hides the sky: beams integrated point by point, what it emits, and what data tell.

Oracles integrate exact patterns (``beams_towards``) with harmonics of scipy in the frame of the
ground, in which terrain does not turn.
"""

from dataclasses import replace
from functools import lru_cache
from itertools import pairwise

import jax
import numpy as np
import pytest
from assertions import close, refuse
from experiments import density_of
from scipy.stats import norm

import lusee_bayes as lb
from lusee_bayes.core.harmonics import synthesis_matrix, turn_about_z
from lusee_bayes.experiment.experiment import Experiment
from lusee_bayes.experiment.model import (
    base_model,
    moved,
    set_up,
    simulate,
    systematics,
    true_model,
    true_values,
)
from lusee_bayes.instrument.beams.monopoles import Monopoles, beams_towards
from lusee_bayes.linear.linear_gaussian import LinearGaussian
from lusee_bayes.systematics.context import Around
from lusee_bayes.systematics.horizon import HorizonSection
from lusee_bayes.systematics.systematic import Systematic

LMAX, ANGLES = 8, (0.0, 40.0)
TRUE = {"horizon_deg": 0.5, "horizon_cos_1_deg": 0.6, "horizon_sin_1_deg": 0.7}
TRUE |= {"horizon_cos_2_deg": -0.3, "horizon_sin_2_deg": 0.4}


def scenario(horizon, *more, lmax=LMAX, step_s=86400.0):
    runs = [f"{{cycles: 1.0, turntable_deg: {angle}}}" for angle in ANGLES]
    plain = [f"lmax={lmax}", f"observation.step_s={step_s}", f"observation.runs=[{','.join(runs)}]"]
    prior = "prior={model: isotropic, spectrum: sky}"
    return lb.load_scenario("fiducial", [*plain, prior, f"noise.horizon={{{horizon}}}", *more])


def integrated(altitude_deg, turntable_deg, splits):
    """What terrain hides of all products, in the frame of the ground.

    Gauss and Legendre in both angles, between the azimuths (from North towards East) of splits.
    """
    x, w = np.polynomial.legendre.leggauss(24)
    total = 0.0
    for low, high in pairwise(splits):
        azimuth = np.radians((high + low) / 2 + (high - low) / 2 * x)
        top = np.radians(altitude_deg(np.degrees(azimuth)))
        t = (x[:, None] + 1) / 2 * top  # altitudes, azimuths
        weight = w[:, None] * top / 2 * np.cos(t) * w * np.radians(high - low) / 2
        phi = np.broadcast_to(np.pi / 2 - azimuth, t.shape)
        ahead = phi - np.radians(turntable_deg)
        unit = [np.cos(t) * np.cos(ahead), np.cos(t) * np.sin(ahead), np.sin(t)]
        beams = beams_towards(25.0, np.stack(unit, -1).reshape(-1, 3), Monopoles())
        harmonics = synthesis_matrix((np.pi / 2 - t).ravel(), phi.ravel(), LMAX)
        total = total + (beams * weight.ravel()) @ harmonics
    return total


# tables by rows; a step is seen to 0.25 degrees
CONSTANT = ([(0, 7), (180, 7)], 1e-12)
RAMPS = ([(0, 0), (20, 5), (90, 6), (100, 0)], 1e-4)
STEP = ([(0, 0), (90, 0), (90.001, 5), (180, 5), (180.001, 0)], 1e-2)


@pytest.mark.parametrize(("rows", "tolerance"), [CONSTANT, RAMPS, STEP])
def test_beams_lose_what_terrain_hides_and_terrain_does_not_turn(tmp_path, rows, tolerance):
    path = tmp_path / "table.csv"
    path.write_text("\n".join(["azimuth_deg,altitude_deg", *(f"{a},{h}" for a, h in rows)]))
    azimuth, altitude = np.array(rows, dtype=float).T
    splits = np.unique([*azimuth, *range(0, 361, 30)])
    section = f"file: {path}, std_deg: 1, treatment: %s"
    setups = [set_up(scenario(section % treatment)) for treatment in ("ignored", "marginalised")]
    for run, angle in enumerate(ANGLES):
        by_hand = integrated(lambda a: np.interp(a, azimuth, altitude, period=360), angle, splits)
        for setup in setups:
            lost = turn_about_z(setup.coupling.modes[run] - setup.beams.modes, np.radians(angle))
            close(lost, -by_hand, tolerance)


@pytest.mark.parametrize("values", [{}, TRUE])
def test_terrain_of_the_skys_temperature_cannot_be_seen(values):
    section = "altitude_deg: 4, std_deg: 2, harmonics: 2, moon_temperature_k: "
    warm, cold, flat = (set_up(scenario(section + k)) for k in ("300", "0", "0"))
    flat = replace(flat, coupling=flat.instrument.coupling_of(flat.beams))
    uniform = np.eye(1, (LMAX + 1) ** 2)[0] * 300.0 * np.sqrt(4.0 * np.pi)
    expected = np.asarray(flat.coupling @ uniform)
    warm, cold = (moved(setup, values) for setup in (warm, cold))
    close(warm.coupling @ uniform + warm.offset, expected, 1e-13)
    assert np.abs(cold.coupling @ uniform - expected).max() > 1e-4 * np.abs(expected).max()
    # the signal, which sets the noise, follows
    seen = np.asarray(warm.coupling @ warm.sky.modes + warm.offset)
    close(warm.layout.gather(warm.signal), seen, 1e-13)


OTHERS = [
    "noise.beam={parameters: {zenith_angle_deg: 0.5, surface_permittivity: 0.2}}",
    "noise.pointing={turntable_deg: 0.5}",
]


def test_about_values_the_model_is_that_of_simulated_data():
    """Beside parameters of the antennas and angles of the turntable."""
    section = "altitude_deg: 3, std_deg: 1, harmonics: 2, moon_temperature_k: 300"
    setup = set_up(scenario(section, *OTHERS))
    truth, model, sky = true_values(setup), base_model(setup), np.asarray(setup.sky.modes)
    expected = np.asarray(true_model(setup, truth).predict(sky))
    for _, systematic in systematics(setup, Around(values=truth)):
        own = {u.name: np.asarray(truth[u.name]) for u in systematic.unknowns}
        model = systematic.effect(model, own)
    close(model.predict(sky), expected, 1e-11)
    assert np.abs(base_model(setup).predict(sky) - expected).max() > 1e-3 * expected.max()


def test_columns_are_the_derivative_of_the_effect():
    """JAX's, and differences. Some altitudes are below zero."""
    setup = set_up(scenario("altitude_deg: 1, std_deg: 2, moon_temperature_k: 300"))
    ((_, horizon),) = systematics(setup)
    centre, model, sky = np.linspace(-1.0, 1.0, 7), base_model(setup), np.asarray(setup.sky.modes)
    assert np.asarray(horizon.altitude(horizon.values(centre))).min() < -0.01
    columns = horizon.derivative(model, sky, centre)
    close(Systematic.derivative(horizon, model, sky, centre), columns, 1e-8)

    def seen(z):
        return np.asarray(horizon.effect(model, horizon.values(z)).predict(sky))

    steps = 1e-3 * np.eye(7)
    differences = [(seen(centre + s) - seen(centre - s)) / 2e-3 for s in steps]
    close(columns, np.stack(differences, axis=1), 1e-5)


def test_the_prior_is_as_wide_in_every_direction():
    ((_, horizon),) = systematics(set_up(scenario("altitude_deg: 1, std_deg: 1.5, harmonics: 4")))
    ways = [horizon.altitude(horizon.values(z)) - horizon.known for z in np.eye(9)]
    np.testing.assert_allclose(np.degrees(np.sqrt(np.square(ways).sum(0))), 1.5, rtol=1e-12)


@lru_cache
def told(treatment):
    """Data of a sky that is drawn, behind 1.5 degrees of terrain where 1 is known, and a map."""
    known = "altitude_deg: 1, std_deg: 1.5, harmonics: 2, moon_temperature_k: 250"
    truth = ", ".join(f"{name}: {value}" for name, value in TRUE.items())
    setup = set_up(scenario(f"{known}, true_values: {{{truth}}}", step_s=43200.0))
    sky = replace(setup.sky, modes=np.asarray(setup.prior.sample(jax.random.key(7))))
    data = simulate(setup.under(sky))
    return lb.infer(lb.build(scenario(f"{known}, treatment: {treatment}", step_s=43200.0), data))


def test_data_tell_the_horizon():
    found, trusting = told("marginalised"), told("ignored")
    (horizon,) = found.expanded
    amplitudes, true = found.amplitudes(horizon), np.array(list(TRUE.values()))
    assert horizon.systematic.names == tuple(TRUE)
    off = horizon.expected + amplitudes.mean - true / horizon.systematic.stds
    assert off @ np.linalg.solve(amplitudes.covariance, off) < 20.5  # 0.1 % of chi^2 of five
    assert amplitudes.std.max() < 0.1 and not found.unsettled
    n = found.model.n_data
    assert found.solution.chi2 < n + 4 * np.sqrt(2 * n) and trusting.solution.chi2 > 10 * n


def test_sampled_the_density_is_that_of_beams_behind_the_terrain():
    known = "altitude_deg: 1, std_deg: 1.5, harmonics: 2, moon_temperature_k: 250"
    setup = set_up(scenario(f"{known}, treatment: sampled", lmax=4))
    there = moved(setup, TRUE)
    e = Experiment(setup, simulate(setup))
    model = LinearGaussian(there.coupling, setup.prior, base_model(setup).noise, there.offset)
    expected = float(model.log_prob(e.data.data))
    expected += norm.logpdf(list(TRUE.values()), 0, 1.5 / np.sqrt(3)).sum()
    assert density_of(e, TRUE) == pytest.approx(expected, rel=1e-8)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("azimuth,altitude_deg\n0,1\n90,2", "has no azimuth_deg"),
        ("azimuth_deg,altitude_deg\n0,1", "has one row; expected two or more"),
        ("azimuth_deg,altitude_deg\n0,1\n90,46", "altitude_deg holds a value outside 0 to 45"),
        ("azimuth_deg,altitude_deg\n0,1\n90,-1", "altitude_deg holds a value outside 0 to 45"),
        ("azimuth_deg,altitude_deg\n0,1\n360,2", "gives a direction twice"),
        ("azimuth_deg,altitude_deg\n0,1\nhigh,2", "azimuth_deg holds values of type"),
    ],
)
def test_tables_that_are_none(tmp_path, text, words):
    path = tmp_path / "table.csv"
    path.write_text(text)
    refuse(words, HorizonSection(file=str(path), std_deg=1.0).table)


def test_what_cannot_be():
    refuse("no table of the horizon", HorizonSection(file="none.csv", std_deg=1.0).table)
    refuse("give file or altitude_deg, what is known", scenario, "std_deg: 1")
    refuse("give either file or", scenario, "std_deg: 1, file: a.csv, altitude_deg: 1")
    wrong = "std_deg: 1, altitude_deg: 1, true_values: {horizon_cos_9_deg: 1}"
    refuse("has 'horizon_cos_9_deg', which is no coeff", true_values, set_up(scenario(wrong)))
