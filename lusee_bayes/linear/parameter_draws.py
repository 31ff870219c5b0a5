"""Draws of a sky whose prior was learned, with the parameters as uncertain as they are.

::

    p(m | d) = int p(m | d, theta) p(theta | d) d theta

The posterior that a run reports is one Gaussian, with the variances' means over theta as its prior.
Where the data hardly tell how strong the sky is, its draws are all of the same strength; those of
p(m | d) are quieter in one sky than in another, and a few departures are far larger. Here theta is
drawn from the normal distribution about its most probable value, and skies from the posterior under
each S(theta).
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, PRNGKeyArray

from lusee_bayes.core.arrays import on_host
from lusee_bayes.core.engine import in_threads
from lusee_bayes.core.errors import InputError
from lusee_bayes.linear.information import Information
from lusee_bayes.linear.learning import Learned
from lusee_bayes.linear.posterior import Posterior
from lusee_bayes.sky.prior_family import PriorFamily

# skies that are drawn with the same theta, and the least number of theta where skies are so many
SHARED, LEAST = 30, 10
# how often a theta is drawn anew whose S is not positive definite to rounding
ATTEMPTS = 5


def draws_with_parameters(
    family: PriorFamily, learned: Learned, posterior: Posterior, key: PRNGKeyArray, n: int
) -> Float[np.ndarray, "draws modes"]:
    """Draw skies; neighbouring ones have different parameters.

    Parameters
    ----------
    family : PriorFamily
    learned : Learned
        Its parameters, and how uncertain they are.
    posterior : Posterior
        Of the same data under the learned prior.
    key : PRNG key
    n : int

    Returns
    -------
    (draws, modes) array
        In K.

    Raises
    ------
    InputError
        If S is not positive definite for five theta in a row.
    """
    drawn = np.empty((n, posterior.prior.size))
    if not n:
        return drawn
    information = information_behind(on_host(posterior))
    root = np.linalg.cholesky(learned.covariance)
    sets = min(n, max(LEAST, -(-n // SHARED)))

    def some(k: int) -> None:
        own = jax.random.fold_in(key, k)
        there = _under_drawn_parameters(family, learned, root, information, own)
        drawn[k::sets] = there.sample(jax.random.fold_in(own, ATTEMPTS), len(drawn[k::sets]))

    in_threads(some, range(sets))
    return drawn


def information_behind(posterior: Posterior) -> Information:
    """What the data said, from the posterior that they gave.

    Parameters
    ----------
    posterior : Posterior
        Over modes of which each is uncertain under the prior; in NumPy's arrays.

    Returns
    -------
    Information
        About the posterior mean; chi^2, ln|N| and the number of data are not known: NaN.
    """
    prior, lower = posterior.prior, np.tril(posterior.lower)
    known = lower @ lower.T - np.eye(len(lower))
    if posterior.basis is not None:
        known = posterior.basis @ known @ posterior.basis.T
    matrix = prior.whiten_columns(prior.whiten_columns(known).T)
    expected = prior.white_mean
    away = posterior.white_mean if expected is None else posterior.white_mean - expected
    unknown = np.asarray(np.nan)
    return Information(
        0.5 * (matrix + matrix.T),
        # at the mean, data and prior pull the same
        prior.whiten_columns(away[None])[0],
        np.asarray(posterior.mean),
        unknown,
        unknown,
        unknown,
    )


def _under_drawn_parameters(
    family: PriorFamily,
    learned: Learned,
    root: Float[np.ndarray, "parameters parameters"],
    information: Information,
    key: PRNGKeyArray,
) -> Posterior:
    for attempt in range(ATTEMPTS):
        z = jax.random.normal(jax.random.fold_in(key, attempt), (len(root),), dtype=jnp.float64)
        parameters = learned.parameters + root @ np.asarray(z)
        try:
            prior = family.prior(family.at(parameters).covariance)
            return information.posterior(prior)
        except InputError as error:
            failed = error
    raise InputError(
        f"no sky can be drawn with the uncertainty of the prior's parameters: {failed}; use "
        "prior.model=isotropic"
    )
