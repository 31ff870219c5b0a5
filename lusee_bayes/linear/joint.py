"""One posterior for the skies of several frequencies.

With m_f = sum_c s_fc a_c + r_f (spectral_prior.py), the residual r_f of each channel is integrated
out by itself. In units of its prior, P = R^1/2 M R^1/2, and ::

    M' = R^-1/2 [1 - (1 + P)^-1] R^-1/2,    v' = R^-1/2 (1 + P)^-1 R^1/2 v

are the channel's information about the common part sum_c s_fc a_c. Sums over channels of
s_fc s_fc' M' are the information of all channels about the component maps, (components x modes)
unknowns, from which the posterior follows as for one sky. Given the components, the residual of
each channel has a posterior of its own, from the channel's data alone.
"""

from __future__ import annotations

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, PRNGKeyArray

from lusee_bayes.core import linalg
from lusee_bayes.core.arrays import Array, Modes, ModesMatrix, on_host
from lusee_bayes.core.checks import require_shape
from lusee_bayes.linear.information import Information
from lusee_bayes.linear.posterior import Posterior
from lusee_bayes.sky.prior import IndependentPrior
from lusee_bayes.sky.spectral_prior import SpectralPrior

# rows that are added at once
ROWS = 16

# arrays that recur
Pairs = Float[Array, "pairs modes modes"]
ChannelModes = Float[Array, "channels modes"]


def common_part(information: Information, residual_root: Modes | None) -> Information:
    """Integrate a channel's residual out of its information about the sky.

    Parameters
    ----------
    information : Information
        About the channel's whole sky.
    residual_root : (modes,) array or None
        R^1/2, the prior standard deviations of the residual, in K; None if there is no residual.

    Returns
    -------
    Information
        About the common part of the channel's sky.
    """
    if residual_root is None:
        return information
    lower = residual_lower(information, residual_root)
    inverse = linalg.inverse_from_cholesky(lower)
    gradient = residual_root * information.vector
    solved = inverse @ gradient
    log_det = 2.0 * np.log(np.diagonal(lower)).sum()
    matrix = -inverse
    matrix[np.diag_indices_from(matrix)] += 1.0
    return replace(
        information,
        matrix=linalg.scaled(matrix, 1.0 / residual_root, overwrite=True),
        vector=solved / residual_root,
        misfit=np.asarray(information.misfit - gradient @ solved),
        log_det=np.asarray(information.log_det + log_det),
    )


def residual_lower(information: Information, residual_root: Modes) -> ModesMatrix:
    """L L^T = 1 + P."""
    normal = linalg.scaled(information.matrix, residual_root)
    normal[np.diag_indices_from(normal)] += 1.0
    return linalg.cholesky(normal, overwrite=True)


class ComponentSums(eqx.Module):
    """Sums over channels that make up the information about the component maps.

    Attributes
    ----------
    matrices : (pairs, modes, modes) array
        sum_f s_fc s_fc' M' for c >= c', row by row, in 1/K^2; what is above the diagonal does not
        count.
    vectors : (components, modes) array
        sum_f s_fc v', in 1/K.
    reference : (components, modes) array
        The reference maps, in K.
    misfit : () array
        Sum of the channels' chi^2 at the reference maps.
    log_det : () array
        Sum of the channels' log determinants.
    n_data : () array
        Number of data of all channels.
    """

    matrices: Pairs
    vectors: Float[Array, "components modes"]
    reference: Float[Array, "components modes"]
    misfit: Float[Array, ""]
    log_det: Float[Array, ""]
    n_data: Float[Array, ""]

    @classmethod
    def empty(cls, prior: SpectralPrior, reference: ChannelModes) -> ComponentSums:
        """Start the sums, with no channel in them.

        Parameters
        ----------
        prior : SpectralPrior
            Of all channels.
        reference : (channels, modes) array
            A reference sky for every channel, near its posterior mean, in K.

        Returns
        -------
        ComponentSums
            Zeros, with the component maps that fit the reference skies best as reference maps.
        """
        k = prior.n_components
        maps = np.linalg.pinv(np.asarray(prior.mixing)) @ np.asarray(reference)
        n, zero = maps.shape[1], np.zeros(())
        matrices = np.zeros((k * (k + 1) // 2, n, n))
        return cls(matrices, np.zeros((k, n)), maps, zero, zero, zero)

    def plus(self, others: ComponentSums) -> ComponentSums:
        """Add the sums of other channels, about the same reference maps; neither is changed."""
        return self._plus(others, "matrices", "vectors", "misfit", "log_det", "n_data")

    def _plus(self, others: ComponentSums | Information, *names: str) -> ComponentSums:
        both = {name: np.asarray(getattr(self, name) + getattr(others, name)) for name in names}
        return replace(self, **both)

    def information(self) -> Information:
        """Information about all component maps in one vector, the first map first."""
        k, n = self.reference.shape
        matrix = np.zeros((k, n, k, n))
        for pair, (i, j) in enumerate(zip(*np.tril_indices(k), strict=True)):
            matrix[i, :, j] = matrix[j, :, i] = linalg.mirrored(self.matrices[pair].copy())
        matrix, vector = matrix.reshape(k * n, k * n), self.vectors.reshape(k * n)
        scalars = self.misfit, self.log_det, self.n_data
        return Information(matrix, vector, self.reference.reshape(k * n), *scalars)


def summed_information(
    sums: ComponentSums, prior: SpectralPrior, channel: int, information: Information
) -> ComponentSums:
    """Add a channel to the sums.

    Parameters
    ----------
    sums : ComponentSums
        Of other channels; its matrices are changed in place.
    prior : SpectralPrior
        Of all channels.
    channel : int
        Number of the channel in the prior.
    information : Information
        Of the channel's data.

    Returns
    -------
    ComponentSums
        The sums with the channel.
    """
    prior = on_host(prior)
    mixing = prior.mixing[channel]
    common = common_part(information, prior.residual_root(channel))
    common = common.recentred(mixing @ sums.reference)
    for pair, (i, j) in enumerate(zip(*np.tril_indices(len(mixing)), strict=True)):
        weight, total = mixing[i] * mixing[j], sums.matrices[pair]
        for first in range(0, len(total), ROWS):  # products that fit into a cache
            lower = slice(first, first + ROWS), slice(0, first + ROWS)
            total[lower] += weight * common.matrix[lower]
    vectors = sums.vectors + mixing[:, None] * common.vector
    return replace(sums, vectors=vectors)._plus(common, "misfit", "log_det", "n_data")


def component_posterior(information: Information, prior: SpectralPrior) -> Posterior:
    """Compute the posterior of all component maps from the information of all channels.

    Parameters
    ----------
    information : Information
        About all component maps in one vector (:meth:`ComponentSums.information`).
    prior : SpectralPrior
        Of all channels.

    Returns
    -------
    Posterior
        Of the component maps in one vector, the first map first.

    Raises
    ------
    InputError
        If the mean does not converge.
    """
    return information.posterior(IndependentPrior(prior.roots.reshape(-1)))


def paired(covariance: Float[Array, "unknowns unknowns"], prior: SpectralPrior) -> Pairs:
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
    return np.stack(
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

    mean: Modes
    covariance: ModesMatrix | None
    draws: Float[Array, "n modes"]
    chi2: Float[Array, ""]


def channel_sky(
    prior: SpectralPrior,
    channel: int,
    information: Information,
    maps: Float[Array, "components modes"],
    covariances: Pairs | None,
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
    prior, maps, covariances, draws, z = on_host((prior, maps, covariances, draws, z))
    mixing, residual_root = prior.mixing[channel], prior.residual_root(channel)
    mean, skies = mixing @ maps, mixing @ draws
    covariance = None
    if covariances is not None:
        first, second = np.tril_indices(len(mixing))
        covariance = np.tensordot(mixing[first] * mixing[second], covariances, 1)
    if residual_root is not None:
        lower = residual_lower(information, residual_root)
        # of the mean and of every draw: the residual's mean, given the common part
        common = np.concatenate([mean[None], skies])
        pull = information.vector - (common - information.reference) @ information.matrix
        half = linalg.solve_lower(lower, (residual_root * pull).T, transpose=False)
        # a draw deviates from it by L^-T z
        half[:, 1:] += z.T
        whole = common + residual_root * linalg.solve_lower(lower, half, transpose=True).T
        mean, skies = whole[0], whole[1:]
        if covariance is not None:
            white = linalg.scaled(covariance, 1.0 / residual_root, overwrite=True)
            white = linalg.inverse_sandwich(white, lower)
            white[np.diag_indices(n_modes)] += 1.0
            white = linalg.sandwich(white, linalg.invert_lower(lower, overwrite=True))
            covariance = linalg.scaled(white, residual_root, overwrite=True)
    return ChannelSky(mean, covariance, skies, information.chi2(mean))
