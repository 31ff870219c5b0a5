"""Systematics from scenario to map: marginalised they cost little, ignored they ruin everything."""

from dataclasses import replace
from functools import lru_cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from assertions import within
from experiments import small_experiment

import lusee_bayes as lb
from lusee_bayes.core.section import Positive, Section, Treatment
from lusee_bayes.experiment import model as models
from lusee_bayes.experiment.experiment import Experiment
from lusee_bayes.experiment.model import full_model, radiometer, simulate, systematics
from lusee_bayes.experiment.rounds import SETTLED, Inference, prediction
from lusee_bayes.experiment.scenario import Scenario
from lusee_bayes.noise.covariance import Covariance, LowRankCovariance, LowRankUpdate
from lusee_bayes.systematics.beam import beam_rms_difference, difference_of_beams
from lusee_bayes.systematics.context import Around, Setup
from lusee_bayes.systematics.registered import SYSTEMATICS, NoiseSection
from lusee_bayes.systematics.systematic import AdditiveNoise, Systematic, Truth, multiplied

GAIN = "noise.gain.sigma=0.01"
SHIFT = "noise.beam.shift_mhz=4"
PARAMETERS = "noise.beam.parameters={length_m: 0.1, zenith_angle_deg: 2.0}"


def experiment(*overrides: str) -> Experiment:
    return small_experiment(*overrides, cycles=0.2)


@lru_cache
def inferred(*overrides: str) -> Inference:
    return lb.infer(experiment(*overrides))


# --- what the gain term is built around -------------------------------------------------------


@pytest.mark.long
def test_the_posteriors_own_prediction_has_settled():
    e, found = (f(GAIN, "noise.gain.visibilities=posterior") for f in (experiment, inferred))
    setup, data, posterior = e.setup, e.data, found.posterior
    assert 2 <= found.rounds <= 10
    predicted = lb.CouplingMatrix.build(setup.beams, setup.pointing) @ posterior.mean
    predicted = predicted.reshape(16, -1)
    # the signal plus A (m - sky) cancels to rounding
    scale = float(jnp.abs(predicted).max())
    within(prediction(setup, found, np.zeros(found.model.n_data)), predicted, 1e-12 * scale)
    gains = {"gains": found.around.gains, "gain_slope": found.around.gain_slope}
    around = Around(data, predicted, **gains)
    again = full_model(setup, around).condition(data.data).posterior
    assert float(again.rms_shift_from(posterior.mean)) < SETTLED
    # it did move on the way
    measured = inferred(GAIN, "noise.gain.visibilities=measured").posterior
    assert float(posterior.rms_shift_from(measured.mean)) > SETTLED


# --- beams ------------------------------------------------------------------------------------


@pytest.mark.long
def test_beam_parameters_are_directions_of_one_sigma():
    """About the sky and the values that were found."""
    setup, found = experiment(PARAMETERS).setup, inferred(PARAMETERS)
    expected = np.diag(np.asarray(radiometer(setup).diagonal()))
    values = found.around.values
    assert isinstance(found.model.noise, LowRankUpdate) and len(values) == 2
    for name, sigma in {"length_m": 0.1, "zenith_angle_deg": 2.0}.items():
        steps = (values | {name: values[name] + step} for step in (1e-4, -1e-4))
        beams = ([f"beam.{key}={value}" for key, value in step.items()] for step in steps)
        plus, minus = (experiment(*one).setup.coupling @ found.around.sky for one in beams)
        moved = sigma * (np.asarray(plus) - np.asarray(minus)) / 2e-4
        expected = expected + np.outer(moved, moved)
    # central differences: h^2 f''' = 1e-8 of the slope
    within(np.asarray(found.model.noise.dense()), expected, 1e-6 * expected.max())
    # the data's own beams differ by a draw of that size
    assert 1e-3 < beam_rms_difference(setup) < 0.3
    assert beam_rms_difference(experiment().setup) is None


def test_a_shifted_beam_is_that_of_the_other_frequency():
    setup, data = experiment(SHIFT).setup, experiment(SHIFT).data
    other = lb.monopole_beams(29.0, 6)
    # the same beams compiled twice: rounding
    within(models.moved(setup, models.true_values(setup)).beams.modes, other.modes, 1e-15)
    change = np.asarray(other.modes) - np.asarray(setup.beams.modes)
    within(difference_of_beams(setup.scenario.noise.beam, setup), change, 1e-15)
    seen = lb.CouplingMatrix.build(other, setup.pointing) @ setup.sky.modes
    z = np.asarray(data.data - seen) / np.sqrt(np.asarray(radiometer(setup).diagonal()))
    assert abs((z**2).sum() - z.size) < 5 * np.sqrt(2 * z.size)


# --- a new noise term of a scenario: in N, in simulated data, among what is sampled ---------------

KEY = "noise.hum"


class HumSection(Section):
    """Three patterns in the data whose amplitudes are not known."""

    sigma_k: Positive = 100.0
    treatment: Treatment = "marginalised"


class NoiseWithHum(NoiseSection):
    """The terms of N, and the hum."""

    hum: HumSection | None = None


class ScenarioWithHum(Scenario):
    """A scenario that can say so."""

    noise: NoiseWithHum = NoiseWithHum()


class Hum(AdditiveNoise):
    """Patterns with unknown amplitudes of zero mean."""

    key = KEY
    section = HumSection

    root: jax.Array

    @classmethod
    def build(cls, section, setup, around):
        return cls("hum", setup.layout, jnp.asarray(patterns(setup.layout.size, section.sigma_k)))

    def covariance(self) -> Covariance:
        return LowRankCovariance(self.root, "the hum")


def patterns(n_data: int, sigma_k: float) -> np.ndarray:
    """(data, 3), rms sigma_k."""
    return sigma_k * np.random.default_rng(5).normal(size=(n_data, 3))


@pytest.fixture
def registered(monkeypatch, tiny_experiment):
    """The term behind those of the package, once there is an experiment without it."""
    monkeypatch.setattr(models, "SYSTEMATICS", (*SYSTEMATICS, Hum))


def setup_with(**section) -> Setup:
    """The small setup with the hum, if there is one."""
    tree = small_experiment().scenario.model_dump()
    tree["noise"]["hum"] = section or None
    return replace(small_experiment().setup, scenario=ScenarioWithHum.model_validate(tree))


def test_it_is_marginalised_into_n(registered):
    setup = setup_with(sigma_k=20.0)
    ((treatment, term),) = systematics(setup)
    assert treatment == "marginalised"
    assert isinstance(term, Hum)
    root = patterns(96, 20.0)
    expected = np.diag(np.asarray(radiometer(setup).diagonal())) + root @ root.T
    within(np.asarray(full_model(setup).noise.dense()), expected, 1e-13 * expected.max())
    # the sky's part of the model is as it was
    kept, own = (jax.tree.leaves(c) for c in (full_model(setup).coupling, setup.coupling))
    for one, other in zip(kept, own, strict=True):
        np.testing.assert_array_equal(one, other)


def test_ignored_or_left_out_it_is_not_in_n(registered):
    for setup in (setup_with(treatment="ignored"), setup_with()):
        assert systematics(setup) == []
        alone = radiometer(setup).diagonal()
        np.testing.assert_array_equal(full_model(setup).noise.diagonal(), alone)


def test_sampled_it_is_left_to_the_program(registered):
    setup = setup_with(treatment="sampled")
    base, (term,) = models.model_to_sample(setup, Around(small_experiment().data))
    assert isinstance(term, Hum)
    np.testing.assert_array_equal(base.noise.diagonal(), radiometer(setup).diagonal())
    # in the model of first order it is in N all the same
    marginalised = full_model(setup_with(treatment="marginalised")).noise.dense()
    np.testing.assert_array_equal(full_model(setup).noise.dense(), marginalised)


def test_simulated_data_hold_it_whatever_its_treatment(registered):
    plain = np.asarray(small_experiment().data.data)
    added = np.asarray(simulate(setup_with()).data) - plain
    # the data without the section are those that they were
    assert not added.any()
    added = np.asarray(simulate(setup_with(treatment="marginalised")).data) - plain
    for treatment in ("sampled", "ignored"):
        data = simulate(setup_with(treatment=treatment)).data
        np.testing.assert_array_equal(np.asarray(data) - plain, added)
    # it is made of the patterns, up to rounding of data of 2e4 K
    root = patterns(96, 100.0)
    amplitudes, *_ = np.linalg.lstsq(root, added, rcond=None)
    within(root @ amplitudes, added, 1e-9)
    assert 0.0 < np.abs(amplitudes).max() < 5.0
    # another seed draws other amplitudes
    reseeded, bare = (
        replace(setup, scenario=setup.scenario.model_copy(update={"seed": 2}))
        for setup in (setup_with(treatment="ignored"), setup_with())
    )
    assert np.abs(np.asarray(simulate(reseeded).data - simulate(bare).data) - added).max() > 1.0


# --- a term with values of its own ----------------------------------------------------------------


class Amplifier(Systematic):
    """A factor that simulated data hold and the model does not know."""

    key = "noise.hum"

    @classmethod
    def truth(cls, section, setup, key) -> Truth:
        return {"factor": 3.0}

    @classmethod
    def in_data(cls, section, setup, model, truth, key):
        return multiplied(model, np.full(model.n_data, truth["factor"]))


def test_systematics_act_in_their_order(monkeypatch):
    """What comes before the amplifier is amplified with the sky; radiometer noise never is."""
    setup = setup_with(sigma_k=100.0)

    def simulated(*more: type[Systematic]) -> np.ndarray:
        monkeypatch.setattr(models, "SYSTEMATICS", (*SYSTEMATICS, *more))
        known = {Hum: "hum_noise", Amplifier: "factor"}
        assert set(models.true_values(setup)) == {known[systematic] for systematic in more}
        return np.asarray(simulate(setup).data)

    signal = np.asarray(setup.layout.gather(setup.signal))
    noise = simulated() - signal
    added = simulated(Hum) - signal - noise
    within(simulated(Hum, Amplifier), 3.0 * (signal + added) + noise, 1e-9)
    within(simulated(Amplifier, Hum), 3.0 * signal + added + noise, 1e-9)
