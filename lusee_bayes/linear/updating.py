"""Update a posterior with new data; the old data are not needed any more.

With the posterior m = m1 + R z, z ~ N(0, 1), new data d = A m + offset + n are data of z, ::

    d = (A R) z + (offset + A m1) + n,

a model like any other, whose evidence is p(new data | old data). R = G L^-T comes from the saved L.
With L of the root form (solver.py) the result equals that of all data together to 1e-9 of a
standard deviation.
"""

from __future__ import annotations

from dataclasses import replace

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from lusee_bayes.core.arrays import Array
from lusee_bayes.core.errors import InputError
from lusee_bayes.core.linalg import solve_lower
from lusee_bayes.linear.model import LinearGaussian
from lusee_bayes.linear.posterior import Posterior
from lusee_bayes.sky.priors import IndependentPrior

# priors are the same if they differ by less, as a part of variances and standard deviations
SAME = 1e-9


def deviation_model(posterior: Posterior, model: LinearGaussian) -> LinearGaussian:
    """Write the model of new data in terms of z, the deviation from an earlier posterior.

    Parameters
    ----------
    posterior : Posterior
        Of the earlier data, in the map-space or root form.
    model : LinearGaussian
        Of the new data alone, with the same prior.

    Returns
    -------
    LinearGaussian
        With the unknowns z ~ N(0, 1).

    Raises
    ------
    InputError
        If the priors differ or are not over harmonic coefficients, or the posterior is of the
        data-space form.
    """
    _require_same_prior(posterior, model)
    if posterior.basis is not None:
        raise InputError(
            "this posterior is of the data-space form; condition with form='root' what is to be "
            "updated later"
        )
    dense = model.coupling.dense()
    offset = dense @ posterior.mean
    return replace(
        model,
        coupling=_in_deviations(posterior, dense),
        prior=IndependentPrior(jnp.ones(posterior.prior.rank)),
        offset=offset if model.offset is None else offset + model.offset,
    )


def updated(posterior: Posterior, model: LinearGaussian, data: Float[Array, " data"]) -> Posterior:
    """Compute the posterior given earlier data and new ones with independent noise.

    Gain drifts that go on from the earlier data into the new ones are not independent: they couple
    the two.

    Parameters
    ----------
    posterior : Posterior
        Of the earlier data, in the map-space or root form.
    model : LinearGaussian
        Of the new data alone, with the same prior.
    data : (data,) array
        The new data, in K.

    Returns
    -------
    Posterior
        Given all data, with the evidence of all data.

    Raises
    ------
    InputError
        As :func:`deviation_model` and :meth:`LinearGaussian.condition`.
    """
    return composed(posterior, deviation_model(posterior, model).condition(data, form="root"))


def composed(posterior: Posterior, deviation: Posterior) -> Posterior:
    """Compute the posterior of m = m1 + R z from that of z.

    Parameters
    ----------
    posterior : Posterior
        Of the earlier data: m1 and R.
    deviation : Posterior
        Of z, the unknowns of :func:`deviation_model`, in the map-space or root form.

    Returns
    -------
    Posterior
        Of the sky given all data.

    Raises
    ------
    InputError
        If ``deviation`` is of the data-space form.
    """
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
    if not (old.invertible and new.invertible) or old.size != new.size:
        raise InputError(
            f"the earlier posterior has {old.size} modes, the new data's model {new.size}; give "
            "both the same lmax and a prior over harmonic coefficients"
        )
    before, now = np.asarray(old.variance()), np.asarray(new.variance())
    if not np.allclose(before, now, rtol=SAME, atol=0.0):
        k = int(np.argmax(np.abs(before - now) / np.maximum(before, now).clip(min=1e-300)))
        raise InputError(
            f"the earlier posterior has another prior: a variance of {before[k]:.4g} K^2 at "
            f"ell = {int(np.sqrt(k))}, now {now[k]:.4g}; give both the same sky and prior"
        )
    widths = np.sqrt(now)
    if not (old.independent and new.independent):
        apart = np.abs(np.asarray(old.covariance()) - np.asarray(new.covariance()))
        if (apart > SAME * widths[:, None] * widths).any():
            raise InputError(
                "the earlier posterior has another prior, with other correlations of the modes; "
                "give both the same sky and prior"
            )
    means = [
        np.zeros(p.size) if p.white_mean is None else np.asarray(p.colour(p.white_mean))
        for p in (old, new)
    ]
    if (np.abs(means[0] - means[1]) > SAME * widths).any():
        raise InputError(
            "the earlier posterior has a prior with another mean; give both the same "
            "prior.mean_file"
        )
