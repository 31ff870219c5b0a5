"""Draws of a posterior: which of them a seed stands for; and what is doubtful about it."""

from __future__ import annotations

from collections.abc import Callable

import jax
import numpy as np
from jaxtyping import PRNGKeyArray

from lusee_bayes.core.arrays import Draws, on_host
from lusee_bayes.experiment.experiment import Experiment
from lusee_bayes.experiment.rounds import Inference
from lusee_bayes.experiment.scenario import Scenario
from lusee_bayes.linear.information import Information
from lusee_bayes.linear.posterior import Posterior
from lusee_bayes.priors.learning import draws_with_parameters

# what the seed is folded with for posterior draws
DRAWS = 1


def draw_key(scenario: Scenario) -> PRNGKeyArray:
    """The key of a scenario's posterior draws."""
    return jax.random.fold_in(jax.random.key(scenario.seed), DRAWS)


def posterior_draws(
    experiment: Experiment, posterior: Posterior, information: Callable[[], Information], n: int
) -> Draws:
    """Draw the sky.

    Where the prior was learned, its parameters are drawn, too (:mod:`.learning`); not for
    data that do not fit, which would not let them be uncertain.

    Parameters
    ----------
    experiment : Experiment
    posterior : Posterior
        The Gaussian posterior.
    information : callable
        ``information()`` of the data behind it, asked for where parameters are drawn.
    n : int

    Returns
    -------
    (draws, modes) array
        In K.
    """
    key, learned = draw_key(experiment.scenario), experiment.learned
    if learned is not None and learned.fits:
        family = experiment.setup.family
        return draws_with_parameters(family, learned, information(), key, n)
    return np.asarray(on_host(posterior).sample(key, n))


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
