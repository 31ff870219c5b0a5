"""Terrain that hides the sky: beams integrated point by point, what it emits, and what data tell.

Oracles integrate exact patterns (``beams_towards``) with harmonics of scipy in the frame of the
ground, in which terrain does not turn.
"""

from dataclasses import replace
from itertools import pairwise

import jax
import numpy as np
import pytest
from assertions import close, off, refuse
from experiments import density_of, differences
from scipy.stats import norm

import lusee_bayes as lb
from lusee_bayes.core.harmonics import synthesis_matrix, turn_about_z
from lusee_bayes.experiment import experiment
from lusee_bayes.experiment import model as models
from lusee_bayes.instrument.beams.monopoles import Monopoles, beams_towards
from lusee_bayes.instrument.products import DataLayout
from lusee_bayes.systematics import context, systematic

LMAX, ANGLES, TREATMENTS = 8, (0.0, 40.0), ("marginalised", "ignored")
KNOWN = "altitude_deg: 1, std_deg: 1.5, harmonics: 2, moon_temperature_k: 250"
TRUE = {"horizon_deg": 0.5, "horizon_cos_1_deg": 0.6, "horizon_sin_1_deg": 0.7}
TRUE |= {"horizon_cos_2_deg": -0.3, "horizon_sin_2_deg": 0.4}


def scenario(horizon, *more, lmax=LMAX, step_s=86400.0):
    runs = [f"{{cycles: 1.0, turntable_deg: {angle}}}" for angle in ANGLES]
    plain = [f"lmax={lmax}", f"observation.step_s={step_s}", f"observation.runs=[{','.join(runs)}]"]
    prior = "prior={model: isotropic, spectrum: sky}"
    return lb.load_scenario("fiducial", [*plain, prior, f"noise.horizon={{{horizon}}}", *more])


def setup_of(*sections, **sizes):
    return models.set_up(scenario(*sections, **sizes))


def written(folder, rows):
    path = folder / "table.csv"
    path.write_text("\n".join(["azimuth_deg,altitude_deg", *(f"{a},{h}" for a, h in rows)]))
    return path


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
    section = f"file: {written(tmp_path, rows)}, std_deg: 1, treatment: %s"
    setups = [setup_of(section % treatment) for treatment in TREATMENTS]
    azimuth, altitude = np.array(rows, dtype=float).T
    splits = np.unique([*azimuth, *range(0, 361, 30)])
    for run, angle in enumerate(ANGLES):
        by_hand = integrated(lambda a: np.interp(a, azimuth, altitude, period=360), angle, splits)
        for setup in setups:
            lost = turn_about_z(setup.coupling.modes[run] - setup.beams.modes, np.radians(angle))
            close(lost, -by_hand, tolerance)


@pytest.mark.parametrize("values", [{}, TRUE])
def test_terrain_of_the_skys_temperature_cannot_be_seen(values):
    section = "altitude_deg: 4, std_deg: 2, harmonics: 2, moon_temperature_k: "
    warm, cold = (models.moved(setup_of(section + k), values) for k in ("300", "0"))
    uniform = np.eye(1, (LMAX + 1) ** 2)[0] * 300.0 * np.sqrt(4.0 * np.pi)
    expected = np.asarray(cold.instrument.coupling() @ uniform)
    close(warm.coupling @ uniform + warm.offset, expected, 1e-13)
    assert off(cold.coupling @ uniform, expected) > 1e-4
    # the signal, which sets the noise, follows
    seen = np.asarray(warm.coupling @ warm.sky.modes + warm.offset)
    close(warm.layout.gather(warm.signal), seen, 1e-13)


ANTENNAS = "noise.beam={parameters: {zenith_angle_deg: 0.5, surface_permittivity: 0.2}}"


def test_about_values_the_model_is_that_of_simulated_data():
    """Beside parameters of the antennas and angles of the turntable."""
    setup = setup_of(KNOWN, ANTENNAS, "noise.pointing={turntable_deg: 0.5}")
    truth, sky, model = models.true_values(setup), setup.sky.modes, models.base_model(setup)
    expected = np.asarray(models.true_model(setup, truth).predict(sky))
    assert off(model.predict(sky), expected) > 1e-3
    for _, one in models.systematics(setup, context.Around(values=truth)):
        model = one.effect(model, {u.name: np.asarray(truth[u.name]) for u in one.unknowns})
    close(model.predict(sky), expected, 1e-11)


def test_columns_are_the_derivative_of_the_effect():
    """JAX's, and differences. Some altitudes are below zero."""
    setup = setup_of("altitude_deg: 1, std_deg: 2, moon_temperature_k: 300")
    ((_, horizon),), centre = models.systematics(setup), np.linspace(-1.0, 1.0, 7)
    model, sky = models.base_model(setup), np.asarray(setup.sky.modes)
    assert np.asarray(horizon.altitude(horizon.values(centre))).min() < -0.01
    columns = horizon.linearised(model, centre)(sky)
    close(systematic.Systematic.linearised(horizon, model, centre)(sky), columns, 1e-8)
    slopes = differences(horizon, model, sky, centre, 1e-3 * np.eye(7))
    for slope, column in zip(slopes.T, columns.T, strict=True):
        close(slope, column, 1e-5)


def test_the_prior_is_as_wide_in_every_direction():
    ((_, horizon),) = models.systematics(setup_of("altitude_deg: 1, std_deg: 1.5, harmonics: 4"))
    ways = [horizon.altitude(horizon.values(z)) - horizon.altitudes for z in np.eye(9)]
    np.testing.assert_allclose(np.degrees(np.sqrt(np.square(ways).sum(0))), 1.5, rtol=1e-12)
    east = np.sin(horizon.azimuth) * np.radians(1.5) / np.sqrt(5)
    np.testing.assert_allclose(ways[horizon.names.index("horizon_sin_1_deg")], east, atol=1e-15)


def test_data_tell_the_horizon():
    """Data of a sky that is drawn, behind terrain that is known but for 1.5 degrees."""
    truth = ", ".join(f"{name}: {value}" for name, value in TRUE.items())
    setup = setup_of(f"{KNOWN}, true_values: {{{truth}}}", step_s=43200.0)
    sky = replace(setup.sky, modes=np.asarray(setup.prior.sample(jax.random.key(7))))
    data = models.simulate(setup.under(sky))
    given = (scenario(f"{KNOWN}, treatment: {t}", step_s=43200.0) for t in TREATMENTS)
    found, trusting = (lb.infer(lb.build(one, data=data)) for one in given)
    (horizon,) = found.expanded
    amplitudes, n, chi2 = found.amplitudes(horizon), found.model.n_data, found.solution.chi2
    assert horizon.systematic.names == tuple(TRUE) and amplitudes.std.max() < 0.1
    away = horizon.expected + amplitudes.mean - list(TRUE.values()) / horizon.systematic.stds
    assert away @ np.linalg.solve(amplitudes.covariance, away) < 20.5  # 0.1 % of chi^2 of five
    assert chi2 < n + 4 * np.sqrt(2 * n) and trusting.solution.chi2 > 10 * n and not found.unsettled


@pytest.mark.essential
def test_sampled_the_density_is_that_of_beams_behind_the_terrain():
    setup = setup_of(f"{KNOWN}, treatment: sampled", lmax=4)
    there, data = models.moved(setup, TRUE), models.simulate(setup)
    noise = models.base_model(setup).noise
    model = lb.LinearGaussian(there.coupling, setup.prior, noise, there.offset)
    expected = float(model.log_prob(data.data))
    expected += norm.logpdf(list(TRUE.values()), 0, 1.5 / np.sqrt(3)).sum()
    assert density_of(experiment.Experiment(setup, data), TRUE) == pytest.approx(expected, rel=1e-8)


def test_other_beams_are_behind_the_terrain_too():
    """A whole shift is what simulated data hold; the terrain hides 8e-5 of what it changes."""
    setup = setup_of(KNOWN, "noise.beam={shift_mhz: 1}", lmax=4)
    (_, beams), *_ = models.systematics(setup)
    got = beams.effect(models.base_model(setup), {"beam_amplitude": 1.0}).coupling
    exact = models.moved(setup, {"beam_amplitude": 1.0}).coupling
    change = np.linalg.norm((exact @ setup.sky.modes) - setup.coupling @ setup.sky.modes)
    assert np.linalg.norm((got @ setup.sky.modes) - exact @ setup.sky.modes) < 1e-9 * change


def test_what_never_rises_is_behind_the_terrain_or_has_no_data():
    hidden = "altitude_deg: 20, std_deg: 1"
    made = experiment.observed(scenario(hidden, "nside=16", lmax=2, step_s=2e4))
    # within 23.8 + 20 degrees of the pole; half a pixel each on the rim
    assert (made.highest_altitude < 0).mean() == pytest.approx(0.139, abs=0.02)
    keep = np.arange(made.data.observation.n_times) < 40
    layout = DataLayout.from_flags(np.tile(~keep, (16, 1)))
    data = layout.gather(made.data.grid())
    flagged = replace(made, data=replace(made.data, data=data, layout=layout))
    few = replace(made, data=made.data.select(keep))
    np.testing.assert_array_equal(flagged.highest_altitude, few.highest_altitude)
    assert (few.highest_altitude < 0).mean() > 0.2


def test_what_cannot_be(tmp_path):
    def tabled(*rows):
        return setup_of(f"file: {written(tmp_path, rows)}, std_deg: 1")

    refuse("one row.*two or more", tabled, (0, 1))
    refuse("altitude_deg.*outside 0 to 45", tabled, (0, 1), (90, 46))
    refuse("azimuth_deg has values of type", tabled, (0, 1), ("high", 2))
    (tmp_path / "other.csv").write_text("azimuth,altitude_deg\n0,1\n90,2")
    refuse("has no azimuth_deg", setup_of, f"file: {tmp_path / 'other.csv'}, std_deg: 1")
    refuse("no table of the horizon", setup_of, "file: none.csv, std_deg: 1")
    refuse("give file or altitude_deg: at", setup_of, "std_deg: 1")
    refuse("6 std_deg", setup_of, "std_deg: 1, altitude_deg: 1, true_values: {horizon_deg: 7}")
    refuse("altitude 0 everywhere", lambda: models.systematics(tabled((0, 0), (90, 0))))
    wrong = setup_of("std_deg: 1, altitude_deg: 1, true_values: {horizon_cos_9_deg: 1}")
    refuse("unknown 'horizon_cos_9_deg'", models.true_values, wrong)
