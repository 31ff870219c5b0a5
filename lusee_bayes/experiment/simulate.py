"""Simulated data: the true instrument, its drifts and fluxes, drawn with the scenario's seed."""

from __future__ import annotations

import jax
from jaxtyping import Float

from lusee_bayes.core.arrays import Array
from lusee_bayes.experiment.model import radiometer
from lusee_bayes.experiment.setup import Setup
from lusee_bayes.experiment.terms import TERMS, Truth, true_beams, true_instrument, true_setup
from lusee_bayes.instrument.coupling import CouplingMatrix
from lusee_bayes.instrument.visibilities import Visibilities


def true_values(setup: Setup) -> Truth:
    """True values of what simulated data hold, by the names of their sites."""
    key = jax.random.key(setup.scenario.seed)
    return {name: value for term in TERMS for name, value in term.truth(setup, key).items()}


def true_signal(setup: Setup, truth: Truth) -> Float[Array, "products times"]:
    """Visibilities of sky, ground and systematics with the true instrument and values, in K."""
    key = jax.random.key(setup.scenario.seed)
    setup = true_setup(setup, truth)
    true = CouplingMatrix.build(true_beams(setup), setup.pointing)
    visibilities = true.layout.scatter(true @ setup.sky.modes)
    visibilities = visibilities + true_instrument(setup).background()[:, None]
    for term in TERMS:
        visibilities = term.distort(visibilities, setup, truth, key)
    return visibilities


def simulate(setup: Setup) -> Visibilities:
    """Visibilities of the scenario's sky, with every draw from its seed."""
    truth = true_values(setup)
    visibilities = true_signal(setup, truth)
    noise = radiometer(setup).scaled(truth.get("noise_level", 1.0))
    return Visibilities(
        setup.layout.gather(visibilities) + noise.sample(jax.random.key(setup.scenario.seed)),
        setup.layout,
        setup.observation,
        setup.scenario.frequency_mhz,
        setup.sky.modes,
    )
