"""The level of the radiometer noise, where it is not known."""

from __future__ import annotations

import jax
from jaxtyping import PRNGKeyArray

from lusee_bayes.experiment.setup import Setup
from lusee_bayes.experiment.terms.term import Around, Term, Truth
from lusee_bayes.systematics import NoiseLevel, Systematic, uncertain_scale

# what the scenario's seed is folded with
DRAW = 4


class NoiseLevelTerm(Term):
    """``noise.radiometer.log_factor_std``; simulated data hold a drawn level."""

    key = "noise.radiometer"

    def build(self, setup: Setup, around: Around) -> list[tuple[str, Systematic]]:
        std = setup.scenario.noise.radiometer.log_factor_std
        return [] if std is None else [("sampled", NoiseLevel(std))]

    def truth(self, setup: Setup, key: PRNGKeyArray) -> Truth:
        std = setup.scenario.noise.radiometer.log_factor_std
        if std is None:
            return {}
        drawn = uncertain_scale(1.0, std).sample(jax.random.fold_in(key, DRAW))
        return {"noise_level": float(drawn)}
