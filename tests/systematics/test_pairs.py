"""Two unknowns at once: each sees what the other does, marginalised in N or sampled."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lusee_bayes as lb
from lusee_bayes.experiment.experiment import program_pieces
from lusee_bayes.experiment.model import true_values
from lusee_bayes.systematics import gain_drifts, systematic
from lusee_bayes.testing import load_scenario, small_scenario

TWO = "observation.runs=[{cycles: 0.12, turntable_deg: 0.0}, {cycles: 0.12, turntable_deg: 40.0}]"
# of (truth - mean) in standard deviations, over 16 modes or more, in each of six cases: beyond
# this once in 1000, as of chi^2 of that many
FARTHEST = 1.6


def distance(scenario):
    """Root mean square of C^-1/2 (truth - mean), and chi^2 in standard deviations from its mean."""
    experiment = lb.build(scenario)
    found, n = lb.infer(experiment), len(experiment.data.data)
    mean, covariance = found.posterior.mean, np.asarray(found.posterior.covariance())
    off = np.asarray(experiment.data.truth)[: len(mean)] - mean
    squared = off @ np.linalg.solve(covariance, off) / len(mean)
    assert not found.unsettled
    return float(np.sqrt(squared)), (float(found.solution.chi2) - n) / np.sqrt(2.0 * n)


# with a learned C_ell
ISOTROPIC = "prior={model: isotropic}"
SHIFT = "noise.beam={shift_mhz: 0.4}"
DRIFTS = "noise.gain={sigma: 0.03, correlation_h: 10.0}"
HORIZON = "noise.horizon={altitude_deg: 5.0, std_deg: 0.5, harmonics: 1}"
POLARISED = "noise.polarisation={linear: 0.03, circular: 0.03, lmax: 4}"
# what was wrong: of beam errors, gains that multiply them, and the terrain that hides them; of
# drifts, what they multiply besides the sky
MARGINALISED = [
    ("noise.gain_table={std: 0.01}", SHIFT),
    pytest.param((DRIFTS, POLARISED), marks=[pytest.mark.long, pytest.mark.essential]),
    pytest.param((DRIFTS, "noise.beam={shift_mhz: 4.0}"), marks=pytest.mark.long),
]


@pytest.mark.parametrize("pair", MARGINALISED, ids=str)
def test_the_map_is_right_with_both_unknown(pair):
    off, z = distance(small_scenario(*pair, lmax=4, cycles=0.2))
    assert off < FARTHEST and abs(z) < 4.0


def test_beam_errors_are_those_above_the_terrain_that_is_found():
    off, z = distance(load_scenario("fiducial", ["lmax=3", TWO, "seed=1", HORIZON, SHIFT]))
    assert off < FARTHEST and abs(z) < 4.0


def test_the_volume_of_skies_is_that_of_a_known_pointing():
    """Latitude and tilt look alike: with N about them all, skies scatter along the difference."""
    runs = "observation.runs=[{cycles: 0.25}, {cycles: 0.25, turntable_deg: 40.0}]"
    unknown = "turntable_deg: 0.2, tilt_east_deg: 0.2, tilt_north_deg: 0.2, lat_deg: 0.1"
    pointing = f"noise.pointing={{{unknown}}}"
    off, z = distance(load_scenario("fiducial", ["lmax=8", runs, "seed=1", pointing]))
    assert off < 1.3 and abs(z) < 4.0


BESIDES = [
    "noise.above_lmax={least_lmax: 0, margin: 4}",
    pytest.param("noise.receiver={power_k: 1000.0, relative_std: 0.2}", marks=pytest.mark.long),
    pytest.param(POLARISED, marks=pytest.mark.long),
    pytest.param("noise.gain_table={std: 0.01}", marks=pytest.mark.long),
]


@pytest.mark.parametrize("other", BESIDES)
def test_sampled_drifts_multiply_what_is_marginalised_once(other):
    """chi^2 of simulated data at their own sky and drifts, in the program's model."""
    drifts = "noise.gain={sigma: 0.01, correlation_h: 10.0, treatment: sampled}"
    scenario = load_scenario("fiducial", ["lmax=3", TWO, drifts, other])
    experiment = lb.build(scenario)
    pieces, values = program_pieces(experiment), dict(true_values(experiment.setup))
    drawn = lb.GainDrift(values["gain_sigma"], values["gain_correlation_h"])
    key = gain_drifts.GainDrifts.own_key(jax.random.key(scenario.seed))
    values["gains"] = drawn.sample(key, experiment.setup.observation.hours)
    model = pieces["gaussian"]()
    for one in pieces["systematics"]():
        if isinstance(one, systematic.Marginalised):
            model = one.sampled(model)
        else:
            model = one.effect(model, {n: jnp.asarray(x) for n, x in values.items()})
    sky, data = jnp.asarray(experiment.data.truth)[: model.prior.size], experiment.data.data
    n = len(data)
    assert abs(float(model.chi2(sky, jnp.asarray(data))) - n) < 4.0 * np.sqrt(2.0 * n)


def test_beam_errors_follow_the_prior_that_is_learned():
    """dA S dA^T of the expected prior would be that of a sky of another strength."""
    experiment = lb.build(small_scenario(ISOTROPIC, "noise.beam.shift_mhz=1", lmax=4, cycles=0.3))
    found, n = lb.infer(experiment), len(experiment.data.data)
    assert experiment.learned.noise_factor == 1.0
    assert abs(float(found.solution.chi2) - n) < 4.0 * np.sqrt(2.0 * n)


def test_the_sky_above_lmax_is_as_strong_if_it_is_sampled():
    def evidence(treatment):
        above = f"noise.above_lmax={{least_lmax: 0, margin: 8, treatment: {treatment}}}"
        scenario = small_scenario(ISOTROPIC, above, lmax=4, cycles=0.2)
        return float(lb.infer(lb.build(scenario)).posterior.log_evidence)

    assert evidence("sampled") == pytest.approx(evidence("marginalised"), rel=1e-9)
