"""The positive sky of one channel, from the joint posterior of the fields."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, PRNGKeyArray

from lusee_bayes.core.arrays import on_host
from lusee_bayes.core.linalg import symmetric_product
from lusee_bayes.linear.information import Information
from lusee_bayes.linear.joint_skies import ChannelSky, channel_sky
from lusee_bayes.linear.positive_joint import PositiveMode, diffuse_part, linearised

# draws whose fields are on the grid at once
CHUNK = 32


def positive_sky(
    mode: PositiveMode,
    channel: int,
    information: Information,
    spread: Float[np.ndarray, "pairs modes modes"],
    draws: Float[np.ndarray, "n fields modes"],
    key: PRNGKeyArray,
) -> ChannelSky:
    """Compute the sky of one channel.

    Its mean is the sky of the mean exponent, and draws are those of exponents' draws: all are
    positive on the grid, but for the point sources. The covariance is W C W^T of the exponent's C.

    Parameters
    ----------
    mode : PositiveMode
    channel : int
        Number of the channel.
    information : Information
        Of the channel's data, in K.
    spread : (pairs, modes, modes) array
        Covariance of the fields as packed by :func:`.paired`.
    draws : (n, fields, modes) array
        Draws of the fields.
    key : PRNGKeyArray
        For draws of residuals and fluxes. Give the same key for all channels of a run.

    Returns
    -------
    ChannelSky
        In K.
    """
    skies, exponent = mode.skies, mode.exponents[channel]
    relative = linearised(skies, channel, information, exponent)
    found = on_host(channel_sky(mode.prior, channel, relative, mode.fields, spread, draws, key))
    beside = diffuse_part(skies, channel, information)
    slope = skies.jacobian(channel, exponent)
    covariance = beside.whole_covariance(symmetric_product(slope @ found.covariance, slope.T))
    mean = beside.whole_sky(skies.modes(channel, found.mean))
    shape = len(draws), len(beside.patterns)
    flux_key = jax.random.fold_in(jax.random.fold_in(key, channel), 1)
    z = np.asarray(jax.random.normal(flux_key, shape, dtype=jnp.float64))
    drawn = np.empty((len(draws), len(mean)))
    for first in range(0, len(draws), CHUNK):
        here = slice(first, first + CHUNK)
        drawn[here] = skies.modes(channel, np.asarray(found.draws[here]))
    whole = on_host(information)
    return ChannelSky(mean, covariance, beside.whole_skies(drawn, z), whole.chi2(mean))
