"""Noise along templates of the user: T P T^T."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Float

from lusee_bayes.core.arrays import Array
from lusee_bayes.core.checks import (
    require_finite,
    require_float64,
    require_positive,
    require_shape,
    require_symmetric,
)
from lusee_bayes.core.linalg import checked_cholesky
from lusee_bayes.instrument.layout import DataLayout
from lusee_bayes.noise.covariance import LowRankCovariance


def template_noise(
    templates: Float[Array, "data templates"],
    prior: Float[Array, " templates"] | Float[Array, "templates templates"],
    layout: DataLayout,
) -> LowRankCovariance:
    """Return the covariance T P T^T of known patterns with amplitudes a ~ N(0, P).

    Parameters
    ----------
    templates : (data, templates) array
        T: one column for each pattern, in K per unit of its amplitude.
    prior : (templates,) or (templates, templates) array
        The variances of the amplitudes, or their covariance P.
    layout : DataLayout

    Returns
    -------
    LowRankCovariance
        In K^2.

    Raises
    ------
    InputError
        For templates of the wrong length, and for a P that is not positive definite.
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
