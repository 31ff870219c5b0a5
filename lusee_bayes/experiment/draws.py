"""Draws of a posterior: which of them a seed stands for; and what is doubtful about it."""

from __future__ import annotations

import jax
import numpy as np
from jaxtyping import PRNGKeyArray

from lusee_bayes.core.arrays import Draws, on_host
from lusee_bayes.experiment.experiment import Experiment
from lusee_bayes.experiment.rounds import Inference
from lusee_bayes.experiment.scenario import Scenario
from lusee_bayes.judge.coverage import N_DRAWS
from lusee_bayes.linear.posterior import Posterior
from lusee_bayes.priors.learning import draws_with_parameters

# what the seed is folded with for posterior draws, and for those that coverage is compared with
DRAWS, COMPARED = 1, 8


def draw_key(scenario: Scenario) -> PRNGKeyArray:
    """The key of a scenario's posterior draws."""
    return jax.random.fold_in(jax.random.key(scenario.seed), DRAWS)


def posterior_draws(
    experiment: Experiment, posterior: Posterior, n: int, purpose: int = DRAWS
) -> Draws:
    """Draw the sky.

    Where the prior was learned, its parameters are drawn, too (:mod:`.learning`); not for
    data that do not fit, which would not let them be uncertain.

    Parameters
    ----------
    experiment : Experiment
    posterior : Posterior
        The Gaussian posterior.
    n : int
    purpose : int
        What the seed is folded with.

    Returns
    -------
    (draws, modes) array
        In K.
    """
    key = jax.random.fold_in(jax.random.key(experiment.scenario.seed), purpose)
    if experiment.learned is not None and experiment.learned.fits:
        family = experiment.setup.family
        return draws_with_parameters(family, experiment.learned, posterior, key, n)
    return np.asarray(on_host(posterior).sample(key, n))


def deviations(experiment: Experiment, posterior: Posterior, n: int = N_DRAWS) -> Draws:
    """Draws of a posterior less its mean, in K, that coverage is compared with."""
    draws = posterior_draws(experiment, posterior, n, COMPARED)
    return draws - np.asarray(posterior.mean)


def doubts(experiment: Experiment, inference: Inference) -> tuple[str, ...]:
    """What is doubtful about an experiment's data, its prior and its rounds."""
    learned, found = experiment.learned, list(experiment.doubts)
    if learned is not None and not learned.settled:
        found.append(
            "The prior is a fixed, wide one: its parameters do not settle, whatever the noise."
        )
    elif learned is not None and learned.noise_factor > 1.0:
        found.append(
            f"The prior was learned with N times {learned.noise_factor:.2g}, as the residual chi^2 "
            "demands; the map has the scenario's N."
        )
    if learned is not None and learned.still_moves > 0.0:
        found.append(
            f"The map still moves by {learned.still_moves:.2g} of its standard deviations from one "
            "round of learning its prior to the next."
        )
    if inference.unsettled:
        found.append(inference.unsettled)
    return tuple(found)
