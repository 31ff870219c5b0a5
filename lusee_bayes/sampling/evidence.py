"""Which program suits the data better: evidences, and ArviZ's comparison of predictions.

Evidence: importance sampling from the Gaussian about the posterior's mode (heavier in the tails),
with its error. Prediction: ln p(d_i | all other data) of every datum with full N, which Pareto
smoothed importance sampling turns into the expected log density of data left out (``compare``).
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import arviz_base
import arviz_stats
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import xarray as xr
from jaxtyping import Float
from numpyro import distributions as dist
from numpyro import handlers
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
        The Gaussian that the draws were proposed from.
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

    Meant for programs of few sites, the sky integrated out. Trust it if the effective number of
    draws is a good share of ``n``.

    Parameters
    ----------
    program : Program
        The program.
    arguments : mapping
        What it asks for, without the data.
    data : (data,) array
        d, in K.
    n : int
        Number of draws.
    seed : int
        Of the draws.

    Raises
    ------
    InputError
        If the mode of the posterior is not found.
    """
    arguments = {**arguments, DATA: jnp.asarray(data)}
    laplace = laplace_approximation(program.model, arguments)
    if not bool(laplace.converged):
        raise InputError(
            f"no mode of the posterior was found in {int(laplace.steps)} steps (the last moved by "
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
    """ln of density over proposal, a Student t in the white coordinates."""
    whitening = laplace.whitening
    size = whitening.root.shape[1]
    proposal = dist.MultivariateStudentT(TAILS, jnp.zeros(size), jnp.eye(size))
    z = proposal.sample(key, (n,))

    model = whitened(program.model, whitening)
    site = f"{whitening.names[0]}{WHITE_SUFFIX}"
    log_p = jax.lax.map(lambda z: -potential_energy(model, (), arguments, {site: z}), z)
    return log_p - proposal.log_prob(z)


def with_log_likelihood(
    tree: xr.DataTree, program: Program, arguments: Mapping[str, Any], *, most: int = 400
) -> xr.DataTree:
    """Make a tree of some of the draws, with a group log_likelihood (chain, draw, datum).

    Parameters
    ----------
    tree : DataTree
        From :func:`~lusee_bayes.sampling.datatree.to_datatree`.
    program : Program
        The program that was sampled.
    arguments : mapping
        What it asks for, without the data.
    most : int
        Use this many draws at most, but one of each chain at least.

    Returns
    -------
    DataTree
        Its posterior has these draws only.

    Raises
    ------
    InputError
        If the program's data are not at a site Marginal or CorrelatedNormal.
    """
    posterior = tree["posterior"].dataset
    each = max(1, most // posterior.sizes["chain"])
    few = posterior.isel(draw=slice(None, None, -(-posterior.sizes["draw"] // each)))
    sites = {str(name): value.values for name, value in few.data_vars.items()}
    data = jnp.asarray(tree["observed_data"][DATA].values)

    def predicted(values):
        """ln p(d_i | all other data, sites) of every datum."""
        model = handlers.substitute(handlers.seed(program.model, 0), values)
        fn = handlers.trace(model).get_trace(**arguments, data=data)[DATA]["fn"]
        if not hasattr(fn, "leave_one_out"):
            raise InputError(
                f"the data of the program '{program.name}' follow {type(fn).__name__}; a "
                "comparison needs Marginal or CorrelatedNormal"
            )
        return fn.leave_one_out(data)

    with numpyro_promotion():
        flat = {name: jnp.reshape(v, (-1, *v.shape[2:])) for name, v in sites.items()}
        rows = np.asarray(jax.lax.map(predicted, flat))
    rows = rows.reshape(few.sizes["chain"], few.sizes["draw"], -1)
    groups = {"posterior": sites, "log_likelihood": {DATA: rows}}
    return arviz_base.from_dict(groups, dims={DATA: ["datum"]}, check_conventions=False)


def compare_programs(trees: Mapping[str, xr.DataTree]) -> pd.DataFrame:
    """Make ArviZ's table of expected log predictive densities, the best program first.

    Programs that sample the sky predict given the sky, collapsed ones without it: do not compare
    one with the other.

    Parameters
    ----------
    trees : mapping of DataTree
        By name, from :func:`with_log_likelihood`, all of the same data.
    """
    with warnings.catch_warnings():
        # of how ArviZ calls pandas
        warnings.filterwarnings("ignore", message="The inplace keyword in")
        return arviz_stats.compare(dict(trees))
