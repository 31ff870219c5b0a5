"""New data for a posterior that is there already: the old data are not needed any more.

With the posterior m = m1 + R z, z ~ N(0, 1), new data d = A m + offset + n are data of z,

    d = (A R) z + (offset + A m1) + n,

a model like any other, whose evidence is p(new data | old data). R = G L^-T comes from the saved L;
with L of the root form (solver.py) the result equals that of all data together to 1e-9 of a
standard deviation.
"""

from __future__ import annotations

from dataclasses import replace

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from lusee_bayes.checks import AnyArray, InputError
from lusee_bayes.coupling import CouplingMatrix
from lusee_bayes.covariance.base import solve_lower
from lusee_bayes.linear_gaussian import LinearGaussian
from lusee_bayes.posterior import Posterior
from lusee_bayes.prior import HarmonicPrior, IndependentPrior


def given(posterior: Posterior, model: LinearGaussian) -> LinearGaussian:
    """The model of new data whose unknowns are z, the deviation from an earlier posterior.

    ``model``: of the new data alone, with the prior of that posterior. InputError for another
    prior, and for a posterior of the data-space form.
    """
    _require_same_prior(posterior, model)
    if posterior.basis is not None:
        raise InputError(
            "this posterior is of the data-space form; condition with form='root' what is to be "
            "updated later"
        )
    a = model.coupling
    dense = a.dense() if isinstance(a, CouplingMatrix) else a
    offset = dense @ posterior.mean
    return replace(
        model,
        coupling=_in_deviations(posterior, dense),
        prior=IndependentPrior(jnp.ones(posterior.prior.rank)),
        offset=offset if model.offset is None else offset + model.offset,
    )


def updated(
    posterior: Posterior, model: LinearGaussian, data: Float[AnyArray, " data"]
) -> Posterior:
    """The posterior given the data of ``posterior`` and new ones, whose noise is independent.

    Drifts that run on from the old data into the new ones are not: they couple the two.
    ``model``: of the new data alone. Its evidence is that of all data. InputError as for
    :func:`given` and :meth:`LinearGaussian.condition`.
    """
    return composed(posterior, given(posterior, model).condition(data, form="root"))


def composed(posterior: Posterior, deviation: Posterior) -> Posterior:
    """The posterior of m = m1 + R z, from that of z, the unknowns of :func:`given`."""
    if deviation.basis is not None:
        raise InputError("condition the deviations with form='root'")
    step = solve_lower(posterior.lower, deviation.white_mean[:, None], transpose=True)[:, 0]
    return Posterior(
        posterior.prior,
        posterior.white_mean + step,
        jnp.tril(posterior.lower) @ jnp.tril(deviation.lower),
        None,
        posterior.log_evidence + deviation.log_evidence,
        deviation.refinement,
    )


@eqx.filter_jit
def _in_deviations(
    posterior: Posterior, dense: Float[Array, "data modes"]
) -> Float[Array, "data white"]:
    """A G L^-T."""
    columns = posterior.prior.colour_columns(dense)
    return solve_lower(posterior.lower, columns.T, transpose=False).T


def _require_same_prior(posterior: Posterior, model: LinearGaussian) -> None:
    old, new = posterior.prior, model.prior
    same = isinstance(old, HarmonicPrior) and isinstance(new, HarmonicPrior)
    if not same or old.size != new.size:
        raise InputError(
            f"the earlier posterior has {old.size} modes, the new data's model {new.size}; give "
            "both the same lmax and a prior over harmonic coefficients"
        )
    if not np.allclose(old.spectrum, new.spectrum, rtol=1e-9, atol=0.0):
        ell = int(np.argmax(np.abs(np.asarray(old.spectrum / new.spectrum) - 1.0)))
        raise InputError(
            f"the earlier posterior has another prior: C_ell = {float(old.spectrum[ell]):.4g} at "
            f"ell = {ell}, now {float(new.spectrum[ell]):.4g}; give both the same sky and prior"
        )
