"""One posterior for the skies of several frequencies, and for the instrument that they share.

With m_f = sum_c s_fc a_c + r_f (spectral_prior.py), each channel's residual r_f is integrated out
independently. In units of its prior, P = R^1/2 M R^1/2, and ::

    M' = R^-1/2 [1 - (1 + P)^-1] R^-1/2,    v' = R^-1/2 (1 + P)^-1 R^1/2 v

are the channel's information about the common part sum_c s_fc a_c. Sums over channels of
s_fc s_fc' M' are the information of all channels about the component maps, (components x modes)
unknowns, from which the posterior follows as for one sky. Given the components, the posterior of
each channel's residual depends only on that channel's data.

Channels may share other unknowns, w ~ N(0, 1) (:meth:`.Shared.information`), which follow the modes
in each channel's information, and the component maps in the sums. With the block M_w of w and the
sky, and the part v_w of w, ::

    M_w' = M_w R^1/2 (1 + P)^-1 R^-1/2,    v_w' = v_w - M_w R^1/2 (1 + P)^-1 R^1/2 v,
    M_ww' = M_ww - M_w R^1/2 (1 + P)^-1 R^1/2 M_w^T.
"""

from __future__ import annotations

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, PRNGKeyArray

from lusee_bayes.core import checks, linalg
from lusee_bayes.core.arrays import Array, Modes, ModesMatrix, Square, Vector, on_host
from lusee_bayes.core.harmonics import n_modes
from lusee_bayes.linear.information import Information, precision_root
from lusee_bayes.linear.posterior import Posterior
from lusee_bayes.sky.prior import IndependentPrior
from lusee_bayes.sky.spectral_prior import SpectralPrior

# rows that are added at once
ROWS = 16

# arrays that recur: blocks of a symmetric matrix row by row, up to its diagonal, and unknowns of
# channels or draws, modes first, then the shared unknowns
Blocks = tuple[Float[Array, "_ _"], ...]
Whole = Float[Array, "count whole"]


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
        About the common part of the channel's sky, and the shared unknowns.
    """
    if residual_root is None:
        return information
    n, lower = len(residual_root), residual_lower(information, residual_root)
    inverse = linalg.inverse_from_cholesky(lower)
    gradient = residual_root * information.vector[:n]
    solved, matrix = inverse @ gradient, -inverse
    vector = solved / residual_root
    matrix[np.diag_indices_from(matrix)] += 1.0
    matrix = linalg.scaled(matrix, 1.0 / residual_root, overwrite=True)
    if information.n_modes > n:
        across = information.matrix[n:, :n] * residual_root
        kept = across @ inverse
        among, seen = information.matrix[n:, n:] - kept @ across.T, kept / residual_root
        matrix = np.block([[matrix, seen.T], [seen, among]])
        vector = np.concatenate([vector, information.vector[n:] - across @ solved])
    misfit = information.misfit - gradient @ solved
    log_det = information.log_det + 2.0 * np.log(np.diagonal(lower)).sum()
    return information.altered(matrix=matrix, vector=vector, misfit=misfit, log_det=log_det)


def residual_lower(information: Information, residual_root: Modes) -> ModesMatrix:
    """L L^T = 1 + P."""
    n = len(residual_root)
    return precision_root(information.matrix[:n, :n], IndependentPrior(residual_root))


def _indices(k: int) -> zip:
    """Rows and columns of the blocks of k components and the shared unknowns."""
    return zip(*np.tril_indices(k + 1), strict=True)


def _weights(prior: SpectralPrior, channel: int) -> Vector:
    """Weights of every component in a channel, and of the shared unknowns."""
    return np.append(prior.mixing[channel], 1.0)


def common_of(
    prior: SpectralPrior, channel: int, unknowns: Float[Array, "*batch unknowns"]
) -> Float[np.ndarray, "*batch whole"]:
    """Extract the common part of a channel's sky, and the shared unknowns, from all unknowns.

    Parameters
    ----------
    prior : SpectralPrior
        Of all channels.
    channel : int
        Number of the channel in the prior.
    unknowns : (..., unknowns) array
        All component maps, one after the other, then the shared unknowns.
    """
    k, n = prior.n_components, n_modes(prior.lmax)
    maps = unknowns[..., : k * n].reshape(*unknowns.shape[:-1], k, n)
    return np.concatenate([prior.mixing[channel] @ maps, unknowns[..., k * n :]], axis=-1)


class ComponentSums(eqx.Module):
    """Sums over channels that make up the information about the component maps.

    Attributes
    ----------
    blocks : tuple of arrays
        sum_f s_fc s_fc' M' for c >= c', row by row, in 1/K^2, of which only lower triangles are
        used; then those of the shared unknowns with each component, and among themselves.
    vector : (unknowns,) array
        sum_f s_fc v', in 1/K, and the part of the shared unknowns.
    reference : (unknowns,) array
        The reference maps, in K, and values of the shared unknowns.
    misfit : () array
        Sum of the channels' chi^2 at the reference.
    log_det : () array
        Sum of the channels' log determinants.
    n_data : () array
        Number of data of all channels.
    n_components : int
    """

    blocks: Blocks
    vector: Vector
    reference: Vector
    misfit: Float[Array, ""]
    log_det: Float[Array, ""]
    n_data: Float[Array, ""]
    n_components: int = eqx.field(static=True)

    @classmethod
    def empty(cls, prior: SpectralPrior, reference: Whole) -> ComponentSums:
        """Start the sums, with no channel in them.

        Parameters
        ----------
        prior : SpectralPrior
            Of all channels.
        reference : (channels, modes + shared) array
            A reference sky for every channel, near its posterior mean, in K, and values of the
            shared unknowns, the same for all.

        Returns
        -------
        ComponentSums
            Zeros; the reference maps are the component maps that best fit the reference skies.
        """
        k, n, reference = prior.n_components, n_modes(prior.lmax), np.asarray(reference)
        maps = np.linalg.pinv(np.asarray(prior.mixing)) @ reference[:, :n]
        at = np.concatenate([maps.reshape(-1), reference[0, n:]])
        sizes, zero = [*[n] * k, reference.shape[1] - n], np.zeros(())
        blocks = tuple(np.zeros((sizes[i], sizes[j])) for i, j in _indices(k))
        return cls(blocks, np.zeros(len(at)), at, zero, zero, zero, k)

    def plus(self, others: ComponentSums) -> ComponentSums:
        """Add the sums of other channels, about the same reference; neither is changed."""
        total = jax.tree.map(lambda a, b: np.asarray(a + b), self, others)
        return replace(total, reference=self.reference)

    def information(self) -> Information:
        """Information about all component maps in one vector, then about the shared unknowns."""
        k, n, size = self.n_components, len(self.blocks[0]), len(self.vector)
        matrix, at = np.empty((size, size)), [slice(c * n, (c + 1) * n) for c in range(k)]
        at.append(slice(k * n, size))
        for (i, j), block in zip(_indices(k), self.blocks, strict=True):
            whole = linalg.mirrored(block.copy()) if i < k else block
            matrix[at[i], at[j]], matrix[at[j], at[i]] = whole, whole.T
        sums = self.misfit, self.log_det, self.n_data
        return Information(matrix, self.vector, self.reference, *sums)


def summed_information(
    sums: ComponentSums, prior: SpectralPrior, channel: int, information: Information
) -> ComponentSums:
    """Add a channel to the sums.

    Parameters
    ----------
    sums : ComponentSums
        Of other channels; its blocks are changed in place.
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
    k, n, weights = prior.n_components, n_modes(prior.lmax), _weights(prior, channel)
    common = common_part(information, prior.residual_root(channel))
    common = common.recentred(common_of(prior, channel, sums.reference))
    parts = [*[slice(0, n)] * k, slice(n, None)]
    for (i, j), total in zip(_indices(k), sums.blocks, strict=True):
        weight, block = weights[i] * weights[j], common.matrix[parts[i], parts[j]]
        for first in range(0, len(total), ROWS):  # the products fit into a cache
            lower = slice(first, first + ROWS), slice(0, first + ROWS if i < k else None)
            total[lower] += weight * block[lower]
    maps = weights[:k, None] * common.vector[:n]
    vector = sums.vector + np.concatenate([maps.reshape(-1), common.vector[n:]])
    names = ("misfit", "log_det", "n_data")
    scalars = {name: np.asarray(getattr(sums, name) + getattr(common, name)) for name in names}
    return replace(sums, vector=vector, **scalars)


def component_posterior(information: Information, prior: SpectralPrior) -> Posterior:
    """Compute the posterior of all component maps and the shared unknowns.

    Parameters
    ----------
    information : Information
        Of all channels (:meth:`ComponentSums.information`).
    prior : SpectralPrior
        Of all channels.

    Returns
    -------
    Posterior
        Of the component maps in one vector, the first map first, then the shared unknowns.

    Raises
    ------
    InputError
        If the mean does not converge.
    """
    roots = np.asarray(prior.roots).reshape(-1)
    shared = np.ones(information.n_modes - len(roots))
    return information.posterior(IndependentPrior(np.concatenate([roots, shared])))


def paired(covariance: Float[Array, "unknowns unknowns"], prior: SpectralPrior) -> Blocks:
    """Pack the covariance of all unknowns for :func:`channel_sky`.

    Parameters
    ----------
    covariance : (unknowns, unknowns) array
        Of :func:`component_posterior`, in K^2.
    prior : SpectralPrior
        Of all channels.

    Returns
    -------
    tuple of arrays
        C_cc, and C_cc' + C_c'c for c > c', row by row, in K^2; then those of the shared unknowns
        with each component, and among themselves.
    """
    k, n = prior.n_components, n_modes(prior.lmax)
    at = [*(slice(c * n, (c + 1) * n) for c in range(k)), slice(k * n, None)]
    return tuple(
        covariance[at[i], at[j]] + (covariance[at[j], at[i]] if j < i < k else 0.0)
        for i, j in _indices(k)
    )


def common_covariance(prior: SpectralPrior, channel: int, covariances: Blocks) -> Square:
    """Compute the covariance of :func:`common_of` from that of all unknowns, in K^2.

    Parameters
    ----------
    prior : SpectralPrior
        Of all channels.
    channel : int
        Number of the channel in the prior.
    covariances : tuple of arrays
        As packed by :func:`paired`.
    """
    k, n, weights = prior.n_components, n_modes(prior.lmax), _weights(prior, channel)
    whole = np.zeros((n + len(covariances[-1]),) * 2)
    parts = [*[slice(0, n)] * k, slice(n, None)]
    for (i, j), block in zip(_indices(k), covariances, strict=True):
        total, weight = whole[parts[i], parts[j]], weights[i] * weights[j]
        for first in range(0, len(total), ROWS):
            rows = slice(first, first + ROWS)
            total[rows] += weight * block[rows]
    whole[:n, n:] = whole[n:, :n].T
    return whole


def sky_slopes(
    prior: SpectralPrior,
    channel: int,
    information: Information,
    lower: ModesMatrix | None,
    rows: Float[Array, "rows modes"],
) -> Float[np.ndarray, "rows unknowns"]:
    """Derivatives of linear functions of a channel's sky by all unknowns.

    Parameters
    ----------
    prior : SpectralPrior
        Of all channels.
    channel : int
        Number of the channel in the prior.
    information : Information
        Of the channel's data.
    lower : (modes, modes) array or None
        :attr:`ChannelSky.lower`.
    rows : (rows, modes) array
        The linear functions.
    """
    n, root = n_modes(prior.lmax), on_host(prior.residual_root(channel))
    seen, shared = rows, np.zeros((len(rows), information.n_modes - n))
    if root is not None:
        half = linalg.solve_lower(lower, (rows * root).T, transpose=False)
        back = linalg.solve_lower(lower, half, transpose=True).T
        seen, shared = back / root, -(root * back) @ information.matrix[:n, n:]
    return np.concatenate([*(w * seen for w in on_host(prior.mixing)[channel]), shared], axis=1)


class ChannelSky(eqx.Module):
    """The posterior of one channel's sky and the shared unknowns, given all data.

    Attributes
    ----------
    mean : (modes + shared,) array
        In K.
    covariance : (modes + shared, modes + shared) array or None
        In K^2; None if the covariance of the component maps was not given.
    draws : (n, modes + shared) array
        In K.
    lower : (modes, modes) array or None
        :func:`residual_lower`; None if there is no residual.
    """

    mean: Float[Array, " whole"]
    covariance: Float[Array, "whole whole"] | None
    draws: Whole
    lower: ModesMatrix | None = None


def channel_sky(
    prior: SpectralPrior,
    channel: int,
    information: Information,
    mean: Float[Array, " unknowns"],
    covariances: Blocks | None,
    draws: Float[Array, "count unknowns"],
    key: PRNGKeyArray,
) -> ChannelSky:
    """Compute the sky of one channel from the posterior of all unknowns.

    Parameters
    ----------
    prior : SpectralPrior
        Of all channels.
    channel : int
        Number of the channel in the prior.
    information : Information
        Of the channel's data.
    mean : (unknowns,) array
        Of the component maps and the shared unknowns, in K.
    covariances : tuple of arrays or None
        Their covariance as packed by :func:`paired`, in K^2; None to omit that of the sky.
    draws : (n, unknowns) array
        Draws of them, in K.
    key : PRNGKeyArray
        For draws of the channel's residual. Give the same key for all channels of a run.

    Returns
    -------
    ChannelSky
        The posterior of the channel's sky.

    Raises
    ------
    InputError
        If ``mean`` does not have the length that prior and information require.
    """
    n = n_modes(prior.lmax)
    shared = information.n_modes - n
    checks.require_shape("the mean of all unknowns", mean, (prior.n_components * n + shared,))
    z = jax.random.normal(jax.random.fold_in(key, channel), (len(draws), n), dtype=jnp.float64)
    prior, mean, covariances, draws, z = on_host((prior, mean, covariances, draws, z))
    residual_root, lower = prior.residual_root(channel), None
    # for the mean and every draw
    whole = common_of(prior, channel, np.concatenate([mean[None], draws]))
    covariance = None if covariances is None else common_covariance(prior, channel, covariances)
    if residual_root is not None:
        lower = residual_lower(information, residual_root)
        # given the common part c, the mean is m0 + R^1/2 (1 + P)^-1 [R^1/2 v + R^-1/2 (c - m0)]
        off = whole - information.reference
        pull = information.vector[:n] - off[:, n:] @ information.matrix[n:, :n]
        towards = residual_root * pull + off[:, :n] / residual_root
        half = linalg.solve_lower(lower, towards.T, transpose=False)
        # a draw deviates from it by R^1/2 L^-T z
        half[:, 1:] += z.T
        moved = residual_root * linalg.solve_lower(lower, half, transpose=True).T
        whole[:, :n] = information.reference[:n] + moved
        if covariance is not None:
            covariance = _with_residual(covariance, information, residual_root, lower)
    return ChannelSky(whole[0], covariance, whole[1:], lower)


def _with_residual(
    covariance: Square, information: Information, residual_root: Modes, lower: ModesMatrix
) -> Square:
    """Covariance of the whole sky from that of the common part, which is overwritten."""
    n = len(residual_root)
    among, slope, across = covariance[n:, n:], np.zeros((n, 0)), np.zeros((n, 0))
    if len(among):
        columns = (information.matrix[:n, n:].T * residual_root, covariance[n:, :n] / residual_root)
        half = linalg.solve_lower(lower, np.concatenate(columns).T, transpose=False)
        back = residual_root[:, None] * linalg.solve_lower(lower, half, transpose=True)
        # slope of the residual with the shared unknowns, and their covariance with the whole sky
        slope = -back[:, : len(among)]
        across = back[:, len(among) :] + slope @ among
    white = linalg.scaled(covariance[:n, :n], 1.0 / residual_root, overwrite=True)
    white = linalg.inverse_sandwich(white, lower, overwrite=True)
    white[np.diag_indices(n)] += 1.0
    white = linalg.inverse_sandwich(white, lower, transpose=True)
    sky = linalg.scaled(white, residual_root, overwrite=True)
    if not len(among):
        return sky
    half = (across - slope @ among / 2.0) @ slope.T
    return np.block([[sky + half + half.T, across], [across.T, among]])
