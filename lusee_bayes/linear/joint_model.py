"""The data of all channels and their skies as one linear Gaussian model, in JAX.

With component maps a_c and residuals r_f (spectral_prior.py) as its unknowns x = (a, r), ::

    L_f^-1 d_f = sum_p s_fp (L_f^-1 A_f) x_p + white noise,    N_f = L_f L_f^T,    s = [s_fc, 1].

It is differentiable by anything in A_f, N_f and the offsets, and can thus be sampled. A joint map,
which sums the information of many channels in NumPy, is :mod:`.joint`.
"""

from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, PRNGKeyArray

from lusee_bayes.core.arrays import Array, DataVector, on_device, on_host
from lusee_bayes.core.linalg import gram_matrix
from lusee_bayes.instrument.coupling import Coupling
from lusee_bayes.linear.linear_gaussian import InMap, LinearGaussian, root_of_precision
from lusee_bayes.noise.covariance import DiagonalCovariance
from lusee_bayes.sky.prior import IndependentPrior
from lusee_bayes.sky.spectral_prior import SpectralPrior


class ChannelCouplings(Coupling):
    """A from maps with known spectra to the data of all channels, one channel after the other.

    Parameters
    ----------
    matrices : tuple of (data, modes) arrays
        From each channel's sky to its data.
    mixing : (channels, maps) array
        Weight of every map in each channel's sky.
    """

    matrices: tuple[Float[Array, "_ modes"], ...]
    mixing: Float[Array, "channels maps"]

    @property
    def shape(self) -> tuple[int, int]:
        return sum(map(len, self.matrices)), self.mixing.shape[1] * self.matrices[0].shape[1]

    def skies(self, maps: Float[Array, "unknowns *n"]) -> Float[Array, "channels modes *n"]:
        """Skies of all channels, given all maps in one vector."""
        by_map = maps.reshape(self.mixing.shape[1], -1, *maps.shape[1:])
        return jnp.tensordot(self.mixing, by_map, 1)

    def _matrix(self):
        return jnp.concatenate([*map(jnp.kron, self.mixing[:, None], self.matrices)])

    def _forward(self, sky):
        return jnp.concatenate([*map(jnp.matmul, self.matrices, self.skies(sky))])

    def _backward(self, data):
        return self._matrix().T @ data

    def gram_matrix(self) -> Float[Array, "unknowns unknowns"]:
        """A^T A, without forming A."""
        grams = jnp.stack([gram_matrix(matrix) for matrix in self.matrices])
        blocks = jnp.einsum("fp,fq,fij->piqj", self.mixing, self.mixing, grams)
        return blocks.reshape(self.shape[1], -1)


class InChannels(InMap):
    """Map-space form of white data of several channels."""

    @staticmethod
    @eqx.filter_jit
    def _factorised(model):
        lower = root_of_precision(model.prior.sandwich(model.coupling.gram_matrix()))
        return model.noise.factor(), jnp.zeros((0, len(lower))), lower, None

    def seen(self, u):
        return self.model.coupling @ self.model.prior.colour(u)


class JointModel(eqx.Module):
    """The posterior over the skies of all channels, and the evidence of their data.

    Attributes
    ----------
    solver : InChannels
        Of white data.
    white : (data,) array
        L_f^-1 (d_f - offset_f) of all channels.
    log_det : () array
        Sum of ln|N_f|.
    """

    solver: InChannels
    white: DataVector
    log_det: Float[Array, ""]

    @classmethod
    def of(
        cls, models: Sequence[LinearGaussian], data: Sequence[Array], prior: SpectralPrior
    ) -> "JointModel":
        """Combine channels.

        Parameters
        ----------
        models : sequence of LinearGaussian
            One for each channel; their own priors on the sky are not used.
        data : sequence of (data,) arrays
            In K.
        prior : SpectralPrior
            Over the skies of all channels.

        Raises
        ------
        InputError
            If a channel's N is not positive definite, or Lambda cannot be factorised.
        """
        prior, white, matrices, log_det = on_host(prior), [], [], 0.0
        for model, seen in zip(models, data, strict=True):
            factor = model.noise.factor()
            white.append(factor.whiten(seen if model.offset is None else seen - model.offset))
            matrices.append(factor.whiten(model.coupling.dense()))
            log_det += factor.log_det()
        mixing, roots = prior.mixing, prior.roots
        if prior.residual is not None:
            rest = [prior.residual_root(number) for number in range(prior.n_channels)]
            mixing, roots = np.hstack([mixing, np.eye(len(rest))]), np.vstack([roots, rest])
        coupling, all_white = ChannelCouplings(tuple(matrices), mixing), jnp.concatenate(white)
        noise = DiagonalCovariance(jnp.ones(len(all_white)))
        model = LinearGaussian(coupling, IndependentPrior(roots.ravel()), noise)
        return cls(InChannels.of(model), all_white, jnp.asarray(log_det))

    def log_prob(self) -> Float[Array, ""]:
        """Evidence ln p(d) of the data in K, with all skies integrated out."""
        return self.solver.log_prob(self.white) - self.log_det / 2.0

    def sample(self, key: PRNGKeyArray) -> Float[Array, "channels modes"]:
        """Draw the skies of all channels from their posterior, in K."""
        posterior = on_device(self.solver.condition(self.white).posterior)
        return self.solver.model.coupling.skies(posterior.sample(key))
