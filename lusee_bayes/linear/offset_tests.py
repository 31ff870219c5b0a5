"""What the data would prefer of something that the model leaves out: score tests of templates.

With K = A S A^T + N the covariance of data under the model and u = K^-1 (d - E[d]), data that hold
a t besides prefer ::

    a = t^T u / F,    F = t^T K^-1 t = t^T N^-1 t - P^T C P,    P = A^T N^-1 t,

with the standard deviation F^(-1/2), C being the covariance of the sky; chi^2 of the data would be
lower by (t^T u)^2 / F. A is not formed.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from lusee_bayes.core.arrays import Array, on_host
from lusee_bayes.linear.model import LinearGaussian
from lusee_bayes.linear.posterior import Posterior

# relative, of a difference of two quadratic forms
ROUNDING = 1e-10


@dataclass(frozen=True)
class Preferences:
    """What the data prefer of each template, all others being left out.

    Attributes
    ----------
    amplitude, std : (n,) array
        NaN where the data say nothing.
    gain : (n,) array
        By how much chi^2 of the data would be lower.
    """

    amplitude: Float[np.ndarray, " n"]
    std: Float[np.ndarray, " n"]
    gain: Float[np.ndarray, " n"]


def preferences(
    model: LinearGaussian,
    posterior: Posterior,
    covariance: Float[np.ndarray, "modes modes"],
    data: Float[Array, " data"],
    templates: Float[np.ndarray, "data n"],
) -> Preferences:
    """Test templates one by one.

    Parameters
    ----------
    model : LinearGaussian
        Without them.
    posterior : Posterior
        Of the model, given these data.
    covariance : (modes, modes) array
        Of the posterior, in K^2.
    data : (data,) array
        d, in K.
    templates : (data, n) array
        t, in K per unit of their amplitudes.

    Returns
    -------
    Preferences
        In these units.

    Raises
    ------
    InputError
        If N is not positive definite.
    """
    model, posterior, data = on_host((model, posterior, data))
    factor = model.noise.factor()
    residual = data - np.asarray(model.predict(posterior.mean))
    pull = templates.T @ np.asarray(factor.solve(residual))
    solved = np.asarray(factor.solve(templates))
    # rows of P^T
    seen = np.stack([np.asarray(model.coupling.transpose_mv(column)) for column in solved.T])
    known = (templates * solved).sum(0) - ((seen @ covariance) * seen).sum(1)
    # what the sky can take up altogether is left with rounding alone
    told = known > ROUNDING * (templates * solved).sum(0)
    inverse = np.divide(1.0, known, out=np.full(len(known), np.nan), where=told)
    return Preferences(pull * inverse, np.sqrt(inverse), pull**2 * inverse)
