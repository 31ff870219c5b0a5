"""How many degrees of freedom of sky and templates each datum determines."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from lusee_bayes.core.arrays import Array, on_host
from lusee_bayes.linear.model import LinearGaussian
from lusee_bayes.linear.posterior import Posterior

# directions of the sky that are seen at once, and entries of A up to which it is made a matrix:
# products of matrices take a tenth of the time
CHUNK, DENSE = 256, 10**8


def data_freedom(
    model: LinearGaussian, posterior: Posterior, columns: Float[Array, "data n"]
) -> Float[np.ndarray, " data"]:
    """Compute the diagonal of K_s K^-1: which share of each datum sky and templates follow.

    With the templates V among the columns of N's square root, K_s = A S A^T + V V^T is the
    covariance of what is no noise, and K = A S A^T + N that of the data. Where V = 0 this is the
    diagonal of A C A^T N^-1. Its sum is the number of modes and templates that the data determine.

    Parameters
    ----------
    model : LinearGaussian
        With ``columns @ columns.T`` in its noise.
    posterior : Posterior
        Of this model, given any data.
    columns : (data, n) array
        V, in K.

    Raises
    ------
    InputError
        If N is not positive definite.
    """
    model, posterior, columns = on_host((model, posterior, columns))
    factor, root = model.noise.factor(), np.asarray(posterior.root())
    weighted_columns = np.asarray(factor.solve(columns))
    solved = weighted_columns
    freedom = np.zeros(model.n_data)
    coupling = model.coupling
    dense = np.asarray(coupling.dense()) if coupling.shape[0] * coupling.shape[1] <= DENSE else None
    for start in range(0, root.shape[1], CHUNK):
        directions = root[:, start : start + CHUNK]
        if dense is not None:
            seen = dense @ directions
        else:
            seen = np.stack([np.asarray(coupling @ r) for r in directions.T], axis=1)
        weighted = np.asarray(factor.solve(seen))
        freedom += (seen * weighted).sum(1)
        solved = solved - weighted @ (seen.T @ weighted_columns)
    return freedom + (columns * solved).sum(1)
