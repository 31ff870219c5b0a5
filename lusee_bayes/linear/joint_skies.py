"""The sky of one channel, from the joint posterior of the component maps.

Given the components, the residual of each channel (:mod:`.joint`) has a posterior of its own, from
the channel's data alone.
"""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, PRNGKeyArray

from lusee_bayes.core.arrays import Array, compiled, namespace, on_processor
from lusee_bayes.core.checks import require_shape
from lusee_bayes.core.linalg import inverse_from_cholesky, scaled, solve_lower, symmetric_product
from lusee_bayes.linear.information import Information
from lusee_bayes.linear.joint import residual_lower
from lusee_bayes.sky.spectral_prior import SpectralPrior


@compiled
def paired(
    covariance: Float[Array, "unknowns unknowns"], prior: SpectralPrior
) -> Float[Array, "pairs modes modes"]:
    """Pack the components' covariance for :func:`channel_sky`.

    Parameters
    ----------
    covariance : (components * modes, components * modes) array
        Of all component maps in one vector, in K^2.
    prior : SpectralPrior
        Of all channels.

    Returns
    -------
    (pairs, modes, modes) array
        C_cc, and C_cc' + C_c'c for c > c', row by row, in K^2.
    """
    k = prior.n_components
    blocks = covariance.reshape(k, -1, k, covariance.shape[0] // k)
    return namespace(covariance).stack(
        [
            blocks[i, :, j] + blocks[j, :, i] if i > j else blocks[i, :, i]
            for i, j in zip(*np.tril_indices(k), strict=True)
        ]
    )


class ChannelSky(eqx.Module):
    """The posterior of one channel's sky, given the data of all channels.

    Attributes
    ----------
    mean : (modes,) array
        In K.
    covariance : (modes, modes) array or None
        In K^2; None if that of the component maps was not given.
    draws : (n, modes) array
        In K.
    chi2 : () array
        Of the channel's data, at the mean.
    """

    mean: Float[Array, " modes"]
    covariance: Float[Array, "modes modes"] | None
    draws: Float[Array, "n modes"]
    chi2: Float[Array, ""]


def channel_sky(
    prior: SpectralPrior,
    channel: int,
    information: Information,
    maps: Float[Array, "components modes"],
    covariances: Float[Array, "pairs modes modes"] | None,
    draws: Float[Array, "n components modes"],
    key: PRNGKeyArray,
) -> ChannelSky:
    """Compute the sky of one channel from the posterior of the component maps.

    Parameters
    ----------
    prior : SpectralPrior
        Of all channels.
    channel : int
        Number of the channel in the prior.
    information : Information
        Of the channel's data.
    maps : (components, modes) array
        Mean of the component maps, in K.
    covariances : (pairs, modes, modes) array or None
        Their covariance as packed by :func:`paired`, in K^2; None if that of the sky is not wanted.
    draws : (n, components, modes) array
        Draws of the component maps, in K.
    key : PRNGKeyArray
        For draws of the channel's residual. Give the same key for all channels of a run.

    Returns
    -------
    ChannelSky
        The posterior of the channel's sky.

    Raises
    ------
    InputError
        If ``maps`` has another number of components than the prior.
    """
    require_shape("the component maps", maps, (prior.n_components, None))
    n_draws, _, n_modes = draws.shape
    z = jax.random.normal(jax.random.fold_in(key, channel), (n_draws, n_modes), dtype=jnp.float64)
    prior, *given = on_processor((prior, information, maps, covariances, draws, z))
    return _channel_sky(prior.mixing[channel], prior.residual_root(channel), *given)


@compiled
def _channel_sky(
    mixing: Array,
    residual_root: Array | None,
    information: Information,
    maps: Array,
    covariances: Array | None,
    draws: Array,
    z: Array,
) -> ChannelSky:
    xp = namespace(information)
    mean, skies = mixing @ maps, mixing @ draws
    covariance = None
    if covariances is not None:
        first, second = np.tril_indices(mixing.shape[0])
        covariance = xp.tensordot(mixing[first] * mixing[second], covariances, 1)
    if residual_root is not None:
        lower = residual_lower(information, residual_root)

        # of the mean and of every draw: the residual's mean, given the common part
        common = xp.concatenate([mean[None], skies])
        pull = (
            information.vector[None] - (common - information.reference[None]) @ information.matrix
        )
        half = solve_lower(lower, (residual_root[None] * pull).T, transpose=False)
        # a draw deviates from it by L^-T z
        half = half + xp.pad(z, ((1, 0), (0, 0))).T
        found = common + residual_root[None] * solve_lower(lower, half, transpose=True).T
        mean, skies = found[0], found[1:]
        if covariance is not None:
            inverse = inverse_from_cholesky(lower)
            white = scaled(covariance, 1.0 / residual_root, overwrite=True)
            white = symmetric_product(inverse @ white, inverse) + inverse
            covariance = scaled(white, residual_root, overwrite=True)
    return ChannelSky(mean, covariance, skies, information.chi2(mean))
