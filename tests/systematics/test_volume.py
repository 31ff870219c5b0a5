"""What the volume of skies that fit does to unknowns that move, against matrices and integrals."""

import jax
import numpy as np
import pytest

import lusee_bayes as lb
from lusee_bayes.experiment import rounds
from lusee_bayes.experiment.model import base_model, set_up, systematics
from lusee_bayes.experiment.scenario import Scenario
from lusee_bayes.systematics import context, systematic

N_DRAWS = 64


def scenario(**noise) -> Scenario:
    runs = [{"cycles": 0.5, "turntable_deg": 30.0 * k} for k in range(2)]
    observation = {"runs": runs, "step_s": 86400.0}
    prior = {"model": "isotropic", "spectrum": "sky"}
    noise = {"radiometer": {"form": "paper"}} | noise
    tree = {"lmax": 4, "observation": observation, "noise": noise, "prior": prior, "seed": 3}
    return Scenario.model_validate(tree)


def test_draws_estimate_the_trace():
    """The slope is -tr(C A^T N^-1 dA) = -tr(B), B = R^T A^T N^-1 dA R with C = R R^T.

    It is the mean of x^T B x for x ~ N(0, 1), whose variance is 2 |B + B^T|^2 / 4 (Frobenius).
    """
    parameters = {"zenith_angle_deg": 1.0, "height_m": 0.05}
    setup = set_up(scenario(beam={"parameters": parameters}))
    ((_, antennas),), model = systematics(setup), base_model(setup)
    values = {"zenith_angle_deg": 75.5, "height_m": 2.02}
    there = antennas.effect(model, values)
    solution = there.condition(np.asarray(there.predict(setup.sky.modes)))
    posterior = solution.posterior
    a, noise = np.asarray(there.coupling.dense()), np.asarray(model.noise.diagonal())
    root = np.linalg.cholesky(np.asarray(posterior.covariance()))
    exact, error = np.zeros(2), np.zeros(2)
    for k, name in enumerate(parameters):
        step = 1e-4 * antennas.stds[k]
        ways = [values | {name: values[name] + s} for s in (step, -step)]
        more, less = (np.asarray(antennas.effect(model, w).coupling.dense()) for w in ways)
        whole = root.T @ a.T @ ((more - less) / 2e-4 / noise[:, None]) @ root
        exact[k] = -np.trace(whole)
        error[k] = np.sqrt(2.0 * (((whole + whole.T) / 2.0) ** 2).sum() / N_DRAWS)
    draws = np.asarray(posterior.sample(jax.random.key(0), N_DRAWS)) - np.asarray(posterior.mean)

    def expected(volume):
        around = context.Around(sky=setup.sky.modes, values=values, volume=volume)
        return np.asarray(systematic.Expanded.at(antennas, model, around).expected)

    assert (np.abs(expected((draws, draws @ a.T / noise, 0.0)) - exact) < 4.0 * error).all()
    assert (np.abs(exact) > 10.0 * error).any()
    # a small problem needs no draws; the differences have a step
    np.testing.assert_allclose(expected(rounds._volume(solution, 2)), exact, rtol=1e-4)
    # what is lost in the scatter of draws is not expected
    assert not expected((draws, draws @ a.T / noise, 1e3)).any()
    assert not expected(None).any()


def test_evidence_is_that_with_the_volume_as_a_factor():
    """N(z; 0, 1) exp(g (z - z_mean)) integrated over z, of the model that is linear about z_0.

    Chi^2 has the square of z_mean, not of its distance from the moved prior mean g.
    """
    experiment = lb.build(scenario(beam={"parameters": {"zenith_angle_deg": 1.0}}))
    found = lb.infer(experiment)
    (part,), data = found.expanded, np.asarray(experiment.data.data)
    values = part.systematic.values(part.centre)
    model = part.systematic.effect(base_model(experiment.setup, found.around), values)
    a, prior = np.asarray(model.coupling.dense()), np.asarray(model.prior.variance())
    noise = np.asarray(model.noise.diagonal())
    rest = data - np.asarray(model.predict(np.zeros(len(prior))))
    (g,), (centre,), column = part.expected, part.centre, part.columns[:, 0]
    assert abs(g) > 0.1
    # of the sky that fits best, and its prior, what is left of data and of the column, in errors
    wide = np.concatenate([a * np.sqrt(prior) / np.sqrt(noise)[:, None], np.eye(len(prior))])
    q, triangle = np.linalg.qr(wide)
    both = np.stack([rest + column * centre, column]) / np.sqrt(noise)
    both = np.concatenate([both, np.zeros((2, len(prior)))], axis=1)
    white, along = both - both @ q @ q.T
    log_det = 2.0 * np.log(np.abs(np.diag(triangle))).sum() + np.log(2.0 * np.pi * noise).sum()
    mean = (along @ white + g) / (1.0 + along @ along)
    z = mean + (1.0 / np.sqrt(1.0 + along @ along)) * np.linspace(-8.0, 8.0, 2001)
    off = ((white[:, None] - along[:, None] * z) ** 2).sum(0) + z**2 - 2.0 * g * (z - mean)
    least = off.min()
    integral = np.log(np.exp(-(off - least) / 2.0).sum() * (z[1] - z[0]) / np.sqrt(2.0 * np.pi))
    expected = integral - least / 2.0 - log_det / 2.0
    assert float(found.posterior.log_evidence) == pytest.approx(expected, abs=1e-6)
    chi2 = ((white - along * mean) ** 2).sum() + mean**2
    assert found.solution.chi2 == pytest.approx(chi2, abs=1e-6)
    # the difference that it makes is not small
    assert abs(g * mean - g**2 / 2.0) > 1e-2
