"""NumPyro pieces built on the package's objects, for use at sample sites.

m ~ SkyPrior(S),    d ~ CorrelatedNormal(A m, N)
d ~ Marginal(model)                                 the same with the sky integrated out
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, PRNGKeyArray
from numpyro import distributions as dist

from lusee_bayes.core.arrays import Array
from lusee_bayes.linear.model import LinearGaussian
from lusee_bayes.noise.covariance import Covariance, Factor
from lusee_bayes.sky.priors import Prior

HALF_LOG_2PI = 0.5 * np.log(2.0 * np.pi)


class SkyPrior(dist.Distribution):
    """m ~ N(mu, S); event (unknowns,).

    Parameters
    ----------
    prior : Prior
        Such as HarmonicPrior.

    Raises
    ------
    InputError
        For a prior without density: one over pixels (S is singular) or with C_ell = 0.
    """

    support = dist.constraints.real_vector
    pytree_data_fields = ("prior",)

    def __init__(self, prior: Prior, *, validate_args: bool | None = None):
        prior.require_density()
        self.prior = prior
        super().__init__(event_shape=(prior.size,), validate_args=validate_args)

    def sample(self, key: PRNGKeyArray, sample_shape: tuple[int, ...] = ()) -> Float[Array, "..."]:
        """Skies of the prior, ``(*sample_shape, unknowns)``, in K."""
        n = int(np.prod(sample_shape))
        return self.prior.sample(key, n).reshape(*sample_shape, self.prior.size)

    def log_prob(self, value: Float[Array, "..."]) -> Float[Array, "..."]:
        """Compute ln p(m) of one sky, or of every row of an array of skies."""
        u = self.prior.whiten(value)
        if self.prior.white_mean is not None:
            u = u - self.prior.white_mean.reshape(*(1,) * (value.ndim - 1), -1)
        return -0.5 * (u**2).sum(-1) - self.prior.log_det() - self.prior.size * HALF_LOG_2PI


class CorrelatedNormal(dist.Distribution):
    """d ~ N(loc, N) for any covariance of the package; event (data,).

    Parameters
    ----------
    loc : (data,) array
        Mean, in K.
    noise : Covariance or Factor
        N. Where it is fixed, give ``noise.factor()``: it is then factorised once and not at every
        evaluation of a model.
    """

    support = dist.constraints.real_vector
    pytree_data_fields = ("factor", "loc")

    def __init__(
        self,
        loc: Float[Array, " data"],
        noise: Covariance | Factor,
        *,
        validate_args: bool | None = None,
    ):
        self.loc = loc
        self.factor = noise.factor() if isinstance(noise, Covariance) else noise
        super().__init__(event_shape=loc.shape, validate_args=validate_args)

    def sample(self, key: PRNGKeyArray, sample_shape: tuple[int, ...] = ()) -> Float[Array, "..."]:
        """Data vectors, ``(*sample_shape, data)``, in K."""
        n = int(np.prod(sample_shape))
        z = jax.random.normal(key, (self.loc.shape[0], n), dtype=jnp.float64)
        draws = self.factor.colour(z).T + self.loc[None]
        return draws.reshape(*sample_shape, -1)

    def log_prob(self, value: Float[Array, "..."]) -> Float[Array, "..."]:
        """Compute ln p(d | loc, N) of one data vector, or of every row of an array."""
        n = self.loc.shape[0]
        residual = (value - self.loc.reshape(*(1,) * (value.ndim - 1), -1)).reshape(-1, n)
        squared = (self.factor.whiten(residual.T) ** 2).sum(0).reshape(value.shape[:-1])
        return -0.5 * (squared + self.factor.log_det()) - n * HALF_LOG_2PI

    def leave_one_out(self, value: Float[Array, " data"]) -> Float[Array, " data"]:
        """Compute ln p(d_i | all other data) of every datum.

        With the precision P and the residual r it is N(d_i - [P r]_i / P_ii, 1 / P_ii).

        Parameters
        ----------
        value : (data,) array
            d, in K.

        References
        ----------
        Buerkner, Gabry & Vehtari 2021, Comput. Stat. 36, 1243.
        """
        root = self.factor.whiten(jnp.eye(self.loc.shape[0]))
        precise = self.factor.solve(value - self.loc)
        return _leave_one_out(precise, (root**2).sum(0))


def _leave_one_out(
    precise: Float[Array, " data"], diagonal: Float[Array, " data"]
) -> Float[Array, " data"]:
    """Log densities from P r and the diagonal of P."""
    return -0.5 * precise**2 / diagonal + 0.5 * jnp.log(diagonal) - HALF_LOG_2PI


class Marginal(dist.Distribution):
    """d with the sky integrated out: the evidence of a linear Gaussian model; event (data,).

    Parameters
    ----------
    model : LinearGaussian
        The model.
    """

    support = dist.constraints.real_vector
    pytree_data_fields = ("model",)

    def __init__(self, model: LinearGaussian, *, validate_args: bool | None = None):
        self.model = model
        super().__init__(event_shape=(model.n_data,), validate_args=validate_args)

    def sample(self, key: PRNGKeyArray, sample_shape: tuple[int, ...] = ()) -> Float[Array, "..."]:
        """Data vectors of skies of the prior, ``(*sample_shape, data)``, in K."""
        keys = jax.random.split(key, int(np.prod(sample_shape)))
        draws = jax.vmap(lambda k: self.model.sample(k)[1])(keys)
        return draws.reshape(*sample_shape, -1)

    def log_prob(self, value: Float[Array, "..."]) -> Float[Array, "..."]:
        """Compute ln p(d) of one data vector, or of every row of an array."""
        solver = self.model.factorise()
        flat = value.reshape(-1, value.shape[-1])
        return jax.vmap(solver.log_prob)(flat).reshape(value.shape[:-1])

    def leave_one_out(self, value: Float[Array, " data"]) -> Float[Array, " data"]:
        """Compute ln p(d_i | all other data) of every datum; see CorrelatedNormal."""
        solver = self.model.factorise()
        white = solver.surprise(value)
        root = solver.factor.whiten(jnp.eye(value.shape[0]))
        # (A S A^T + N)^-1 = L^-T (1 - H^T H) L^-1,  H = L_Lambda^-1 W^T
        half = solver.half()
        inner = white - half.T @ (half @ white)
        diagonal = (root**2).sum(0) - ((half @ root) ** 2).sum(0)
        return _leave_one_out(solver.factor.whiten_transpose(inner), diagonal)
