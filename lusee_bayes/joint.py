"""One posterior for the skies of several frequencies.

With m_f = sum_c s_fc a_c + r_f (spectral_prior.py), the rest r_f of each channel is integrated out
by itself: in units of its prior, P = R^1/2 M R^1/2,

    M' = R^-1/2 [1 - (1 + P)^-1] R^-1/2,    v' = R^-1/2 (1 + P)^-1 R^1/2 v,

is what the channel says of the common part. Sums over channels of s_fc s_fc' M' are what all of
them say of the component maps: information about (components x modes) unknowns, from which the
posterior follows as for one sky. Given the components, each rest has a posterior of its own.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from lusee_bayes.checks import AnyArray, InputError, require_shape
from lusee_bayes.covariance.base import solve_lower
from lusee_bayes.gram import symmetric_product
from lusee_bayes.information import Information
from lusee_bayes.inverse import inverse_from
from lusee_bayes.posterior import Posterior
from lusee_bayes.prior import IndependentPrior
from lusee_bayes.spectral_prior import SpectralPrior


@eqx.filter_jit
def common_part(
    information: Information, rest: Float[Array, " modes"] | None, key: PRNGKeyArray | None = None
) -> Information:
    """What a channel says of c = sum_c s_c a_c; its rest, of these deviations, is integrated out.

    ``key``: for the perturbations, if it has any: they are to be draws of N(0, M'), and
    R^-1/2 (1 + P)^-1 (P z + R^1/2 e) is one, with e of N(0, M); without it they are dropped.
    """
    e = None if key is None else information.perturbations
    if rest is None:
        return replace(information, perturbations=e)
    lower = _rest_lower(information, rest)
    inverse = inverse_from(lower)
    pull = rest * information.vector
    left = inverse @ pull
    log_det = 2.0 * jnp.log(jnp.diagonal(lower)).sum()
    if e is not None:
        z = jax.random.normal(key, e.shape, dtype=jnp.float64)
        e = (z + (rest[None] * e - z) @ inverse) / rest[None]
    return Information(
        (jnp.eye(rest.shape[0]) - inverse) / rest[:, None] / rest[None],
        left / rest,
        information.about,
        information.misfit - pull @ left,
        information.log_det + log_det,
        information.n_data,
        e,
    )


def _rest_lower(
    information: Information, rest: Float[Array, " modes"]
) -> Float[Array, "modes modes"]:
    """L L^T = 1 + P."""
    normal = rest[:, None] * information.matrix * rest[None] + jnp.eye(rest.shape[0])
    return jax.lax.linalg.cholesky(normal, symmetrize_input=False)


class ComponentSums(eqx.Module):
    """Sums over channels that make up the information about the component maps.

    matrices : (pairs, modes, modes) sum_f s_fc s_fc' M' for c >= c', row by row; vectors :
    (components, modes); about : (components, modes) the maps that everything is written about
    """

    matrices: Float[Array, "pairs modes modes"]
    vectors: Float[Array, "components modes"]
    about: Float[Array, "components modes"]
    misfit: Float[Array, ""]
    log_det: Float[Array, ""]
    n_data: Float[Array, ""]

    @classmethod
    def empty(cls, prior: SpectralPrior, about: Float[AnyArray, "channels modes"]) -> ComponentSums:
        """Nothing yet; ``about``: a sky for every channel, near which the maps are to lie."""
        k = prior.n_components
        start = jnp.asarray(np.linalg.pinv(np.asarray(prior.mixing)) @ np.asarray(about))
        n, zero = start.shape[1], jnp.zeros(())
        matrices = jnp.zeros((k * (k + 1) // 2, n, n))
        return cls(matrices, jnp.zeros((k, n)), start, zero, zero + 0.0, zero + 0.0)

    def information(self) -> Information:
        """Of all component maps in one vector, the first map first."""
        return _assembled(self)


@eqx.filter_jit(donate="all-except-first")
def _with_channel(
    channel: tuple[Information, Array, Array | None], sums: ComponentSums
) -> ComponentSums:
    """Sums with one channel more (information, mixing, rest); the given sums are used up."""
    information, mixing, rest = channel
    here = common_part(information, rest).recentred(mixing @ sums.about)
    first, second = np.tril_indices(mixing.shape[0])
    weights = mixing[first] * mixing[second]
    return ComponentSums(
        sums.matrices + weights[:, None, None] * here.matrix[None],
        sums.vectors + mixing[:, None] * here.vector[None],
        sums.about,
        sums.misfit + here.misfit,
        sums.log_det + here.log_det,
        sums.n_data + here.n_data,
    )


@eqx.filter_jit
def _assembled(sums: ComponentSums) -> Information:
    k, n = sums.about.shape
    pair = {}
    for number, (i, j) in enumerate(zip(*np.tril_indices(k), strict=True)):
        pair[i, j] = pair[j, i] = sums.matrices[number]
    rows = [jnp.concatenate([pair[i, j] for j in range(k)], axis=1) for i in range(k)]
    return Information(
        jnp.concatenate(rows),
        sums.vectors.reshape(k * n),
        sums.about.reshape(k * n),
        sums.misfit,
        sums.log_det,
        sums.n_data,
    )


def solve_directly(
    prior: SpectralPrior, channels: Iterable[Information], about: Float[AnyArray, "channels modes"]
) -> Posterior:
    """The posterior of all component maps (in one vector) given every channel's information.

    ``channels`` are gone through once, in the order of the prior's; ``about``: a sky for each,
    such as their own ``about``. Evidence included. InputError if there are more or fewer.
    """
    sums, count = ComponentSums.empty(prior, about), 0
    for channel, information in enumerate(channels):
        if channel >= prior.n_channels:
            raise InputError(f"there are more channels than the prior's {prior.n_channels}")
        sums, count = summed(sums, prior, channel, information), channel + 1
    if count != prior.n_channels:
        raise InputError(f"there are {count} channels, the prior is for {prior.n_channels}")
    return component_posterior(sums.information(), prior)


def summed(
    sums: ComponentSums, prior: SpectralPrior, channel: int, information: Information
) -> ComponentSums:
    """The sums with one channel more; the given ones are used up."""
    rest = prior.residual_root(channel)
    return _with_channel((information, prior.mixing[channel], rest), sums)


def component_posterior(told: Information, prior: SpectralPrior) -> Posterior:
    """The posterior of all component maps, in one vector, given what all channels say of them."""
    return told.posterior(IndependentPrior(prior.roots.reshape(-1)))


@eqx.filter_jit
def paired(
    covariance: Float[Array, "unknowns unknowns"], prior: SpectralPrior
) -> Float[Array, "pairs modes modes"]:
    """The components' covariance for :func:`channel_sky`: C_cc, and C_cc' + C_c'c for c > c'."""
    k = prior.n_components
    blocks = covariance.reshape(k, -1, k, covariance.shape[0] // k)
    return jnp.stack(
        [
            blocks[i, :, j] + blocks[j, :, i] if i > j else blocks[i, :, i]
            for i, j in zip(*np.tril_indices(k), strict=True)
        ]
    )


@dataclass(frozen=True)
class ChannelSky:
    """The posterior of one channel's sky, all channels' data given; in K.

    mean : (modes,); covariance : (modes, modes), None where only draws tell; draws : (n, modes)
    chi2 : of its data about the mean; chi2_expected : its mean if the model holds, N_data less the
    trace of M times the covariance, NaN without it
    """

    mean: Float[Array, " modes"]
    covariance: Float[Array, "modes modes"] | None
    draws: Float[Array, "n modes"]
    chi2: Float[Array, ""]
    chi2_expected: Float[Array, ""]


def channel_sky(
    prior: SpectralPrior,
    channel: int,
    information: Information,
    maps: Float[Array, "components modes"],
    spread: Float[Array, "pairs modes modes"] | None,
    draws: Float[Array, "n components modes"],
    key: PRNGKeyArray,
) -> ChannelSky:
    """The sky of one channel from the posterior of the component maps.

    maps, spread, draws : mean, covariance (:func:`paired`) and draws of the components; ``key`` :
    for the draws of the channel's rest, the same for all channels of a run.
    """
    require_shape("the component maps", maps, (prior.n_components, None))
    found = _channel_sky(
        prior.mixing[channel],
        prior.residual_root(channel),
        information,
        maps,
        spread,
        draws,
        jax.random.fold_in(key, channel),
    )
    return ChannelSky(*found)


@eqx.filter_jit
def _channel_sky(
    mixing: Array,
    rest: Array | None,
    information: Information,
    maps: Array,
    pairs: Array | None,
    draws: Array,
    key: PRNGKeyArray,
) -> tuple[Array, Array | None, Array, Array, Array]:
    mean, skies = mixing @ maps, jnp.einsum("c,dcm->dm", mixing, draws)
    spread = None
    if pairs is not None:
        first, second = np.tril_indices(mixing.shape[0])
        spread = jnp.tensordot(mixing[first] * mixing[second], pairs, 1)
    if rest is not None:
        lower = _rest_lower(information, rest)

        def remaining(common: Array) -> Array:
            """Mean of the rest, given the common part."""
            pull = rest * (information.vector - information.matrix @ (common - information.about))
            half = solve_lower(lower, pull[:, None], transpose=False)
            return rest * solve_lower(lower, half, transpose=True)[:, 0]

        z = jax.random.normal(key, skies.shape, dtype=jnp.float64)
        loose = rest[None] * solve_lower(lower, z.T, transpose=True).T
        skies = skies + jax.vmap(remaining)(skies) + loose
        mean = mean + remaining(mean)
        if spread is not None:
            x = inverse_from(lower)
            inner = symmetric_product(x @ (spread / rest[:, None] / rest[None]), x) + x
            spread = rest[:, None] * inner * rest[None]
    expected = jnp.asarray(jnp.nan)
    if spread is not None:
        expected = information.n_data - (information.matrix * spread).sum()
    return mean, spread, skies, information.chi2(mean), expected
