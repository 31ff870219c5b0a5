"""A new noise term of a scenario: in N, in simulated data, among what is sampled."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from experiments import small_experiment
from reference_linear import assert_draws_follow

from lusee_bayes.experiment import model as model_module
from lusee_bayes.experiment.experiment import build
from lusee_bayes.experiment.model import (
    full_model,
    model_to_sample,
    radiometer,
    simulate,
    systematics,
    true_values,
)
from lusee_bayes.experiment.noise_sections import NoiseSection
from lusee_bayes.experiment.scenario import Scenario
from lusee_bayes.experiment.section import Positive, Section, Treatment
from lusee_bayes.experiment.setup import Setup
from lusee_bayes.experiment.term import AdditiveTerm, Around, Term, Truth
from lusee_bayes.experiment.terms import TERMS
from lusee_bayes.noise.covariance import Covariance, LowRankCovariance
from lusee_bayes.systematics.systematic import AdditiveNoise

KEY = "noise.hum"
TREATMENTS = ("marginalised", "sampled", "ignored")


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

    root: jax.Array

    def covariance(self) -> Covariance:
        return LowRankCovariance(self.root, "the hum")


def patterns(n_data: int, sigma_k: float) -> np.ndarray:
    """(data, 3), rms sigma_k."""
    return sigma_k * np.random.default_rng(5).normal(size=(n_data, 3))


def hum(setup: Setup, section: HumSection) -> Hum:
    """The term of a scenario."""
    root = jnp.asarray(patterns(setup.layout.size, section.sigma_k))
    return Hum("hum", setup.layout, root)


TERM = AdditiveTerm(KEY, hum)


@pytest.fixture
def registered(monkeypatch, tiny_experiment):
    """The term behind those of the package, once there is an experiment without it."""
    for module in (model_module,):
        monkeypatch.setattr(module, "TERMS", (*TERMS, TERM))


def with_hum(**section) -> Scenario:
    """The small scenario with the hum, if there is one."""
    tree = small_experiment().scenario.model_dump()
    tree["noise"]["hum"] = section or None
    return ScenarioWithHum.model_validate(tree)


def setup_with(**section) -> Setup:
    return replace(small_experiment().setup, scenario=with_hum(**section))


def test_it_is_marginalised_into_n(registered):
    setup = setup_with(sigma_k=20.0)
    ((treatment, term),) = systematics(setup)
    assert treatment == "marginalised"
    assert isinstance(term, Hum)
    root = patterns(96, 20.0)
    expected = np.diag(np.asarray(radiometer(setup).diagonal())) + root @ root.T
    got = np.asarray(full_model(setup).noise.dense())
    np.testing.assert_allclose(got, expected, rtol=0, atol=1e-13 * expected.max())
    # the sky's part of the model is as it was
    kept, own = (jax.tree.leaves(c) for c in (full_model(setup).coupling, setup.coupling))
    for one, other in zip(kept, own, strict=True):
        np.testing.assert_array_equal(one, other)


def test_ignored_or_left_out_it_is_not_in_n(registered):
    for setup in (setup_with(treatment="ignored"), setup_with()):
        assert systematics(setup) == []
        np.testing.assert_array_equal(
            full_model(setup).noise.diagonal(), radiometer(setup).diagonal()
        )


def test_sampled_it_is_left_to_the_program(registered):
    setup = setup_with(treatment="sampled")
    base, (term,) = model_to_sample(setup, Around(small_experiment().data))
    assert isinstance(term, Hum)
    np.testing.assert_array_equal(base.noise.diagonal(), radiometer(setup).diagonal())


def test_simulated_data_hold_it_whatever_its_treatment(registered):
    plain = np.asarray(small_experiment().data.data)
    added = {t: np.asarray(simulate(setup_with(treatment=t)).data) - plain for t in TREATMENTS}
    for treatment in TREATMENTS:
        np.testing.assert_array_equal(added[treatment], added["marginalised"])
    # it is made of the patterns, up to rounding of data of 2e4 K
    root = patterns(96, 100.0)
    amplitudes, *_ = np.linalg.lstsq(root, added["marginalised"], rcond=None)
    left = added["marginalised"] - root @ amplitudes
    assert np.abs(left).max() < 1e-9
    assert 0.0 < np.abs(amplitudes).max() < 5.0
    # the data without the section are those that they were
    np.testing.assert_array_equal(simulate(setup_with()).data, plain)
    # another seed draws other amplitudes
    reseeded, bare = (
        replace(setup, scenario=setup.scenario.model_copy(update={"seed": 2}))
        for setup in (setup_with(treatment="ignored"), setup_with())
    )
    other = np.asarray(simulate(reseeded).data - simulate(bare).data)
    assert np.abs(other - added["ignored"]).max() > 1.0


def test_its_draws_have_its_covariance(registered):
    """2000 seeds: the amplitudes are independent unit normals."""
    setup, root = setup_with(sigma_k=100.0), patterns(96, 100.0)
    nothing = jnp.zeros((16, setup.observation.n_times))
    keys = jax.random.split(jax.random.key(7), 2000)
    drawn = jax.vmap(lambda key: TERM.distort(nothing, setup, {}, key))(keys)
    noise = np.asarray(jax.vmap(setup.layout.gather)(drawn))
    amplitudes = noise @ np.linalg.pinv(root).T
    np.testing.assert_allclose(amplitudes @ root.T, noise, rtol=0, atol=1e-11 * np.abs(noise).max())
    assert_draws_follow(amplitudes, np.zeros(3), np.eye(3))


def test_a_whole_experiment_knows_its_noise(registered):
    """chi^2 of noise about the true signal: right with the hum in N, absurd without it."""
    experiment = build(with_hum(sigma_k=100.0))
    setup = experiment.setup
    off = experiment.data.data - setup.layout.gather(setup.signal)
    right = float((off * full_model(setup, Around(experiment.data)).noise.solve(off)).sum())
    wrong = float((off**2 / radiometer(setup).diagonal()).sum())
    n = off.shape[0]
    assert abs(right - n) < 5 * np.sqrt(2 * n)
    assert wrong > 100 * n


# --- a term with values of its own ----------------------------------------------------------------


class Amplifier(Term):
    """A factor that simulated data hold and the model does not know."""

    key = "amplifier"

    def build(self, setup, around):
        return []

    def truth(self, setup, key) -> Truth:
        return {"factor": 3.0}

    def distort(self, visibilities, setup, truth, key):
        return truth["factor"] * visibilities


def test_terms_distort_in_their_order(monkeypatch):
    """What comes before the amplifier is amplified with the sky; radiometer noise never is."""
    setup = setup_with(sigma_k=100.0)

    def simulated(*terms: Term) -> np.ndarray:
        monkeypatch.setattr(model_module, "TERMS", (*TERMS, *terms))
        assert true_values(setup) == ({"factor": 3.0} if Amplifier in map(type, terms) else {})
        return np.asarray(simulate(setup).data)

    signal = np.asarray(setup.layout.gather(setup.signal))
    noise = simulated() - signal
    added = simulated(TERM) - signal - noise
    close = {"rtol": 0, "atol": 1e-9}
    np.testing.assert_allclose(
        simulated(TERM, Amplifier()), 3.0 * (signal + added) + noise, **close
    )
    np.testing.assert_allclose(simulated(Amplifier(), TERM), 3.0 * signal + added + noise, **close)
