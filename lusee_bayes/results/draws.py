"""Which random draws a scenario's seed stands for."""

from __future__ import annotations

import jax
import numpy as np
from jaxtyping import Float, PRNGKeyArray

from lusee_bayes.core.arrays import on_host
from lusee_bayes.experiment.scenario import Scenario
from lusee_bayes.linear.posterior import Posterior
from lusee_bayes.results.coverage import N_DRAWS

# what the seed is folded with for posterior draws, for perturbations of information, and for the
# draws that coverage is compared with
DRAWS, PERTURBATIONS, COMPARED = 1, 7, 8


def draw_key(scenario: Scenario) -> PRNGKeyArray:
    """The key of a scenario's posterior draws."""
    return jax.random.fold_in(jax.random.key(scenario.seed), DRAWS)


def perturbation_key(scenario: Scenario) -> PRNGKeyArray:
    """The key of the perturbations of a scenario's information."""
    return jax.random.fold_in(jax.random.key(scenario.seed), PERTURBATIONS)


def deviations(
    posterior: Posterior, scenario: Scenario, n: int = N_DRAWS
) -> Float[np.ndarray, "draws modes"]:
    """Draws of a posterior less its mean, in K, that coverage is compared with."""
    posterior = on_host(posterior)
    key = jax.random.fold_in(jax.random.key(scenario.seed), COMPARED)
    return np.asarray(posterior.sample(key, n)) - np.asarray(posterior.mean)
