"""The temperature of the ground."""

from __future__ import annotations

import jax
import numpy as np
from jaxtyping import Float, PRNGKeyArray

from lusee_bayes.core.arrays import Array
from lusee_bayes.experiment.emission import ground_per_kelvin
from lusee_bayes.experiment.setup import Setup
from lusee_bayes.experiment.terms.beam_error import true_instrument
from lusee_bayes.experiment.terms.term import Around, Term, Truth
from lusee_bayes.systematics import LinearUnknowns, Systematic

# what the scenario's seed is folded with
DRAW = 9
NAME = "regolith_k"


class RegolithTerm(Term):
    """``noise.regolith``; simulated data hold the emission of ground of a drawn temperature."""

    key = "noise.regolith"

    def build(self, setup: Setup, around: Around) -> list[tuple[str, Systematic]]:
        section = setup.scenario.noise.regolith
        if section is None or section.treatment == "ignored":
            return []
        added = ground_per_kelvin(setup.beam_source, setup.scenario.frequency_mhz)
        template = added[np.asarray(setup.layout.product), None] * section.std_k
        mean = np.array([setup.scenario.beam.moon_temperature_k])
        ground = LinearUnknowns((NAME,), mean, np.array([section.std_k]), template)
        return [(section.treatment, ground)]

    def truth(self, setup: Setup, key: PRNGKeyArray) -> Truth:
        section = setup.scenario.noise.regolith
        if section is None:
            return {}
        z = float(jax.random.normal(jax.random.fold_in(key, DRAW)))
        return {NAME: setup.scenario.beam.moon_temperature_k + section.std_k * z}

    def distort(
        self,
        visibilities: Float[Array, "products times"],
        setup: Setup,
        truth: Truth,
        key: PRNGKeyArray,
    ) -> Float[Array, "products times"]:
        if setup.scenario.noise.regolith is None:
            return visibilities
        true = true_instrument(setup)
        warmer = truth[NAME] - setup.scenario.beam.moon_temperature_k
        return visibilities + warmer * ground_per_kelvin(true.source, true.frequency_mhz)[:, None]
