"""Noise along templates that the user brings: T P T^T."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

from lusee_bayes.checks import (
    require_finite,
    require_float64,
    require_positive,
    require_shape,
    require_symmetric,
)
from lusee_bayes.covariance import LowRankCovariance
from lusee_bayes.covariance.base import checked_cholesky
from lusee_bayes.layout import DataLayout


def template_noise(
    templates: Float[Array, "data templates"],
    prior: Float[Array, " templates"] | Float[Array, "templates templates"],
    layout: DataLayout,
) -> LowRankCovariance:
    """Covariance of amplitudes a ~ N(0, P) of known patterns in the data: T P T^T, in K^2.

    templates : T, one column for each pattern, in K per unit of its amplitude; prior : the
    amplitudes' variances, or their covariance P. InputError for templates of the wrong length and
    for a P that is not positive definite.
    """
    require_float64("the templates", templates)
    require_shape("the templates", templates, (layout.size, None))
    require_finite("the templates", templates)
    require_float64("the templates' prior", prior)
    n = templates.shape[1]
    if prior.ndim == 1:
        require_shape("the templates' prior", prior, (n,))
        require_positive("the templates' prior variance", prior)
        return LowRankCovariance(templates * jnp.sqrt(prior)[None], "the templates")
    require_shape("the templates' prior", prior, (n, n))
    require_finite("the templates' prior", prior)
    require_symmetric("the templates' prior", prior)
    root = jnp.tril(checked_cholesky("the templates' prior", prior))
    return LowRankCovariance(templates @ root, "the templates")
