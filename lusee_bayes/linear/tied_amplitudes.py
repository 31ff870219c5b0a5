"""Amplitudes of several channels that are tied to one another, where each was worked out alone.

Channel k has amplitudes z_k, N(0, 1) when it is worked out, and its posterior of them is
N(E_k, V_k). Its likelihood is then exp(-z^T (V_k^-1 - 1) z / 2 + z^T V_k^-1 E_k) up to a factor.
Let the prior of all of them be N(0, K x 1) instead: K_kk = 1 ties the channels' values of one
amplitude, and different amplitudes are independent. With K = R R^T and z = R w, w ~ N(0, 1), ::

    Lambda = 1 + sum_k R_k^T (V_k^-1 - 1) R_k,    mean of w = Lambda^-1 sum_k R_k^T V_k^-1 E_k,

which needs no inverse of K. What follows for channel k, N(E'_k, V'_k), is its own posterior times
exp(-z^T Q z / 2 + q^T z), which is what the other channels tell of its amplitudes: ::

    Q = V'^-1 - V^-1,    q = V'^-1 E' - V^-1 E.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from lusee_bayes.core.errors import InputError
from lusee_bayes.core.linalg import solve_lower
from lusee_bayes.linear.information import Information
from lusee_bayes.linear.templates import AmplitudesOfSky

# the mean is repeated on what is left: rounding is then that of E - z, not of z
REFINEMENTS = 2


@dataclass(frozen=True)
class Tied:
    """Posterior of amplitudes given the data of all channels.

    Attributes
    ----------
    mean : (channels, n) array
    covariance : (channels, n, n) array
        Of each channel's amplitudes.
    draws : (draws, channels, n) array
        Of all channels together.
    log_evidence : float
        ln p of all data, less the sum of the channels' ln p with amplitudes of N(0, 1).
    """

    mean: Float[np.ndarray, "channels n"]
    covariance: Float[np.ndarray, "channels n n"]
    draws: Float[np.ndarray, "draws channels n"]
    log_evidence: float


def tie(
    mean: Float[np.ndarray, "channels n"],
    covariance: Float[np.ndarray, "channels n n"],
    kernel: Float[np.ndarray, "channels channels"],
    normals: Float[np.ndarray, "draws white"],
) -> Tied:
    """Give amplitudes that were independent from channel to channel a prior that ties them.

    Parameters
    ----------
    mean, covariance : (channels, n) and (channels, n, n) array
        E and V: of each channel's own data, with amplitudes of N(0, 1).
    kernel : (channels, channels) array
        K, with ones on its diagonal; it may be singular.
    normals : (draws, channels * n) array
        Standard normals, of which draws are made.

    Raises
    ------
    InputError
        If a covariance is not positive definite.
    """
    n_channels, n = mean.shape
    if not (np.linalg.eigvalsh(covariance) > 0).all():
        raise InputError(
            "the data tell the powers of receivers better than rounding lets their covariance be "
            "known; leave out noise.receiver.smooth_octaves"
        )
    strength, vectors = np.linalg.eigh(kernel)
    root = np.kron(vectors * np.sqrt(np.maximum(strength, 0.0)), np.eye(n))
    blocks = root.reshape(n_channels, n, -1)
    told = np.linalg.inv(covariance)
    pulled = np.einsum("kij,kjw->kiw", told - np.eye(n), blocks)
    precision = np.eye(root.shape[1]) + root.T @ pulled.reshape(root.shape)
    lower = np.linalg.cholesky(precision)
    white, z = np.zeros(root.shape[1]), np.zeros(mean.shape)
    for _ in range(1 + REFINEMENTS):
        pull = np.einsum("kij,kj->ki", told, mean - z) + z
        left = (root.T @ pull.ravel() - white)[:, None]
        step = solve_lower(lower, solve_lower(lower, left, transpose=False), transpose=True)
        white = white + step[:, 0]
        z = (root @ white).reshape(mean.shape)
    half = solve_lower(lower, root.T, transpose=False).T.reshape(n_channels, n, -1)
    draws = solve_lower(lower, normals.T, transpose=True).T @ root.T
    off = mean - z
    quadratic = np.einsum("ki,kij,kj->", off, told, off) - (z**2).sum() + white @ white
    log_dets = np.linalg.slogdet(covariance)[1].sum() + 2.0 * np.log(np.diagonal(lower)).sum()
    return Tied(
        z,
        half @ np.swapaxes(half, 1, 2),
        z + draws.reshape(-1, n_channels, n),
        float(-0.5 * (quadratic + log_dets)),
    )


def told_by_others(
    mean: Float[np.ndarray, " n"],
    covariance: Float[np.ndarray, "n n"],
    tied_mean: Float[np.ndarray, " n"],
    tied_covariance: Float[np.ndarray, "n n"],
) -> tuple[Float[np.ndarray, "n n"], Float[np.ndarray, " n"]]:
    """Q and q of one channel, from its own posterior and that given all data."""
    own, tied = np.linalg.inv(covariance), np.linalg.inv(tied_covariance)
    return tied - own, own @ (tied_mean - mean) + (tied - own) @ tied_mean


def information_given(
    information: Information,
    amplitudes: AmplitudesOfSky,
    precision: Float[np.ndarray, "n n"],
    vector: Float[np.ndarray, " n"],
) -> Information:
    """What data say of the sky where amplitudes are known to be N((1 + Q)^-1 q, (1 + Q)^-1).

    ::

        M + P^T W P,    v + P^T (1 + Q D)^-1 (Q z - q),    W = (1 + Q D)^-1 Q,

    of z = ``amplitudes.mean``, D = ``amplitudes.covariance`` and P = ``amplitudes.pull``.

    Parameters
    ----------
    information : Information
        With amplitudes of N(0, 1).
    amplitudes : AmplitudesOfSky
        About the same reference sky.
    precision : (n, n) array
        Q.
    vector : (n,) array
        q.
    """
    z, pull, inner = amplitudes.mean, amplitudes.pull, amplitudes.covariance
    one = np.eye(len(z))
    mixed = one + precision @ inner
    gradient = np.linalg.solve(mixed, vector - precision @ z)
    weight = np.linalg.solve(mixed, precision)
    least = z + inner @ gradient
    misfit = gradient @ inner @ gradient + least @ (precision @ least - 2.0 * vector)
    misfit += vector @ np.linalg.solve(one + precision, vector)
    log_det = np.linalg.slogdet(mixed)[1] - np.linalg.slogdet(one + precision)[1]
    return replace(
        information,
        matrix=np.asarray(information.matrix) + pull.T @ (0.5 * (weight + weight.T)) @ pull,
        vector=np.asarray(information.vector) - pull.T @ gradient,
        misfit=np.asarray(information.misfit + misfit),
        log_det=np.asarray(information.log_det + log_det),
    )
