"""Evidences, which compare how well programs fit the data.

They are estimated, with errors, by importance sampling from a Student t about the posterior's mode.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from numpyro import distributions as dist
from numpyro.infer.util import potential_energy

from lusee_bayes.core.arrays import Array
from lusee_bayes.core.errors import InputError
from lusee_bayes.sampling.hmc import whitened
from lusee_bayes.sampling.mode import LaplaceApproximation, laplace_approximation
from lusee_bayes.sampling.programs import DATA, WHITE_SUFFIX, Program, numpyro_promotion

# degrees of freedom of the proposal, whose tails are heavier than a Gaussian's
TAILS = 7.0


@dataclass(frozen=True)
class Evidence:
    """The evidence of a program.

    Attributes
    ----------
    log_evidence : float
        ln p(d).
    error : float
        Its standard error.
    effective : float
        Effective number of draws.
    laplace : LaplaceApproximation
        The Gaussian about the mode, behind the proposal.
    """

    log_evidence: float
    error: float
    effective: float
    laplace: LaplaceApproximation


def estimate_evidence(
    program: Program,
    arguments: Mapping[str, Any],
    data: Float[Array, " data"],
    *,
    n: int = 400,
    seed: int = 0,
) -> Evidence:
    """Estimate ln p(d) with everything that the program samples integrated out.

    Use it for programs with few sites, the sky integrated out. Trust it if the effective number of
    draws is a good share of ``n``.

    Parameters
    ----------
    program : Program
        The program.
    arguments : mapping
        Its arguments, without the data.
    data : (data,) array
        d, in K.
    n : int
        Number of draws.
    seed : int
        Seed of the draws.

    Raises
    ------
    InputError
        If the search for the posterior's mode does not converge.
    """
    arguments = {**arguments, DATA: jnp.asarray(data)}
    laplace = laplace_approximation(program.model, arguments)
    if not bool(laplace.converged):
        raise InputError(
            f"found no mode of the posterior in {int(laplace.steps)} steps (last step: "
            f"{float(laplace.moved):.2g} standard deviations); narrow the priors"
        )
    with numpyro_promotion():
        weights = np.asarray(_log_weights(program, arguments, laplace, n, jax.random.key(seed)))
    largest, relative = weights.max(), np.exp(weights - weights.max())
    error = relative.std(ddof=1) / relative.mean() / np.sqrt(n)
    effective = relative.sum() ** 2 / (relative**2).sum()
    log_evidence = largest + np.log(relative.mean())
    return Evidence(float(log_evidence), float(error), float(effective), laplace)


@eqx.filter_jit
def _log_weights(
    program: Program, arguments: dict[str, Any], laplace: LaplaceApproximation, n: int, key
) -> Float[Array, " draws"]:
    """ln of density over proposal, which is a Student t in the white coordinates."""
    whitening = laplace.whitening
    size = whitening.root.shape[1]
    proposal = dist.MultivariateStudentT(TAILS, jnp.zeros(size), jnp.eye(size))
    z = proposal.sample(key, (n,))

    model = whitened(program.model, whitening)
    site = f"{whitening.names[0]}{WHITE_SUFFIX}"
    log_p = jax.lax.map(lambda z: -potential_energy(model, (), arguments, {site: z}), z)
    return log_p - proposal.log_prob(z)
