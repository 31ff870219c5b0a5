"""Draws of a posterior: which of them a seed stands for, and whether they can be trusted."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

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


# R-hat and effective sizes a chain that are enough (Vehtari et al. 2021); an R-hat far from it, and
# the share of diverged draws that is
AGREE, PER_CHAIN, FAR, FEW = 1.01, 100, 1.05, 0.01
CRITERIA = (
    f"Wanted: R-hat of at most {AGREE:g}, effective sizes of {PER_CHAIN} for each chain, no "
    f"divergences. Bad: R-hat above {FAR:g}, or more than {FEW:.0%} of the draws diverged."
)


def warnings_of(table: Mapping[str, np.ndarray], sampling: Mapping[str, Any]) -> list[str]:
    """Why draws are not to be trusted yet, and what to do; empty if there is no reason.

    Parameters
    ----------
    table : mapping
        Columns of summary.csv: quantity, r_hat, ess_bulk, ess_tail.
    sampling : mapping
        sampling.json.
    """
    found = []
    names, r_hat = table["quantity"], np.nan_to_num(table["r_hat"], nan=-np.inf, posinf=np.inf)
    above = int((r_hat > AGREE).sum())
    if above:
        furthest = int(np.argmax(r_hat))
        found.append(
            f"Not converged: R-hat is above {AGREE:g} for {above} of {len(names)} quantities, most "
            f"for {names[furthest]} ({r_hat[furthest]:.3f}). Raise --draws."
        )
    least = PER_CHAIN * sampling["chains"]
    for column, what in (("ess_bulk", "bulk"), ("ess_tail", "tail")):
        if column not in table:
            continue
        size = np.nan_to_num(table[column], nan=np.inf)
        few = int((size < least).sum())
        if few:
            worst = int(np.argmin(size))
            found.append(
                f"The {what} effective size is below {least} for {few} of {len(names)} quantities, "
                f"least for {names[worst]} ({size[worst]:.0f}): raise --draws."
            )
    if sampling["divergences"]:
        found.append(
            f"{sampling['divergences']} trajectories diverged: the steps are too long where the "
            "posterior is narrow. Raise --warmup; if that does not help, write the program in "
            "coordinates in which its posterior is wide."
        )
    return found
