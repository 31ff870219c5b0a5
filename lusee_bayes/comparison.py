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
from jaxtyping import Array, Float
from numpyro import distributions as dist
from numpyro import handlers
from numpyro.infer.util import potential_energy

from lusee_bayes.checks import AnyArray, InputError
from lusee_bayes.laplace import Laplace, laplace
from lusee_bayes.programs import Program

# degrees of freedom of the proposal, whose tails are heavier than a Gaussian's
TAILS = 7.0
DATA = "data"


@dataclass(frozen=True)
class Evidence:
    """ln p(d) of a program, its standard error, and how many of the draws count."""

    log_evidence: float
    error: float
    effective: float
    laplace: Laplace


def evidence(
    program: Program,
    arguments: Mapping[str, Any],
    data: Float[AnyArray, " data"],
    *,
    n: int = 400,
    seed: int = 0,
) -> Evidence:
    """ln p(d) with everything that the program samples integrated out.

    ``arguments``: what the program asks for. Meant for programs of few sites, the sky integrated
    out: ``effective``, of ``n`` draws, tells whether it can be trusted. InputError if the mode of
    the posterior is not found.
    """
    arguments = {**arguments, DATA: jnp.asarray(data)}
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        about = laplace(program.model, arguments).require_converged()
        weights = np.asarray(_log_weights(program, arguments, about, n, jax.random.key(seed)))
    relative = np.exp(weights - weights.max())
    log_mean = weights.max() + np.log(relative.mean())
    effective = relative.sum() ** 2 / (relative**2).sum()
    error = relative.std(ddof=1) / relative.mean() / np.sqrt(n)
    return Evidence(float(log_mean), float(error), float(effective), about)


@eqx.filter_jit
def _log_weights(
    program: Program, arguments: dict[str, Any], about: Laplace, n: int, key
) -> Float[Array, " draws"]:
    """ln of density over proposal, a Student t in the white coordinates."""
    whitening = about.whitening
    size = whitening.root.shape[1]
    proposal = dist.MultivariateStudentT(TAILS, jnp.zeros(size), jnp.eye(size))
    z = proposal.sample(key, (n,))

    def one(z):
        x = whitening.split(whitening.mean + whitening.root @ z)
        return whitening.log_det - potential_energy(program.model, (), arguments, x)

    return jax.lax.map(one, z) - proposal.log_prob(z)


def pointwise(
    program: Program,
    arguments: Mapping[str, Any],
    data: Float[AnyArray, " data"],
    sites: Mapping[str, np.ndarray],
) -> Float[np.ndarray, "chains draws data"]:
    """ln p(d_i | all other data, sites) for every draw (chains, draws, ...) of the sites.

    InputError for a program whose data are not at a site Marginal or CorrelatedNormal.
    """
    shape = next(iter(sites.values())).shape[:2]
    flat = {
        name: jnp.asarray(v).reshape(shape[0] * shape[1], *v.shape[2:]) for name, v in sites.items()
    }
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        rows = _pointwise(program, {**arguments, DATA: jnp.asarray(data)}, flat)
    return np.asarray(rows).reshape(*shape, -1)


@eqx.filter_jit
def _pointwise(
    program: Program, arguments: dict[str, Any], sites: dict[str, Array]
) -> Float[Array, "draws data"]:
    def one(values):
        model = handlers.substitute(handlers.seed(program.model, 0), values)
        fn = handlers.trace(model).get_trace(**arguments)[DATA]["fn"]
        if not hasattr(fn, "leave_one_out"):
            raise InputError(
                f"the data of the program '{program.name}' follow {type(fn).__name__}; a "
                "comparison needs Marginal or CorrelatedNormal"
            )
        return fn.leave_one_out(arguments[DATA])

    return jax.lax.map(one, sites)


def with_log_likelihood(
    tree: xr.DataTree,
    program: Program,
    arguments: Mapping[str, Any],
    *,
    most: int = 400,
) -> xr.DataTree:
    """The tree with a group log_likelihood (chain, draw, datum), of ``most`` draws at most.

    One of each chain is kept at least. The posterior of the tree that is returned has these draws
    only.
    """
    posterior = tree["posterior"].dataset
    each = max(1, most // posterior.sizes["chain"])
    step = -(-posterior.sizes["draw"] // each)
    few = posterior.isel(draw=slice(None, None, step))
    data = tree["observed_data"]["data"].values
    sites = {str(name): value.values for name, value in few.data_vars.items()}
    rows = pointwise(program, arguments, data, sites)
    return arviz_base.from_dict(
        {"posterior": sites, "log_likelihood": {DATA: rows}},
        dims={DATA: ["datum"]},
        check_conventions=False,
    )


def compare(trees: Mapping[str, xr.DataTree]) -> pd.DataFrame:
    """ArviZ's table of expected log predictive densities, the best program first.

    trees : by name, from :func:`with_log_likelihood`, all of the same data. Programs that sample
    the sky predict given the sky, collapsed ones without it: do not compare one with the other.
    """
    with warnings.catch_warnings():
        # of how ArviZ calls pandas
        warnings.filterwarnings("ignore", message="The inplace keyword in")
        return arviz_stats.compare(dict(trees))
