"""Amplitudes of templates that are part of the noise, as point sources' fluxes are.

With N = N_0 + T T^T, an amplitude of each column of T is N(0, 1) before there are data. With
K = A S A^T + N the covariance of data under the model, and C that of the sky, ::

    mean = T^T K^-1 (d - offset) = T^T N^-1 (d - offset - A m),    m the posterior mean of the sky,
    covariance = 1 - T^T K^-1 T = 1 - T^T N^-1 T + P C P^T,        P = T^T N^-1 A.

A is not formed.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from lusee_bayes.core.arrays import Array, on_host
from lusee_bayes.linear.model import LinearGaussian
from lusee_bayes.linear.posterior import Posterior


def template_amplitudes(
    model: LinearGaussian,
    posterior: Posterior,
    data: Float[Array, " data"],
    templates: Float[Array, "data n"],
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, "n n"]]:
    """Compute the posterior of templates' amplitudes, with the sky integrated out.

    Parameters
    ----------
    model : LinearGaussian
        With ``templates @ templates.T`` in its noise.
    posterior : Posterior
        Of this model, given these data alone.
    data : (data,) array
        d, in K.
    templates : (data, n) array
        T, in K.

    Returns
    -------
    mean : (n,) array
        In prior standard deviations.
    covariance : (n, n) array
        The unit matrix where the data say nothing.

    Raises
    ------
    InputError
        As :meth:`Posterior.covariance`, and if N is not positive definite.
    """
    model, posterior, data, t = on_host((model, posterior, data, templates))
    factor = model.noise.factor()
    residual = data - np.asarray(model.predict(posterior.mean))
    solved = np.asarray(factor.solve(t))
    pulled = np.stack([model.coupling.transpose_mv(column) for column in solved.T])
    left = pulled @ posterior.covariance() @ pulled.T
    return solved.T @ residual, np.eye(t.shape[1]) - t.T @ solved + left
