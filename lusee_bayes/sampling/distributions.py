"""NumPyro distributions built from the package's objects, for use at sample sites.

They are ::

    m ~ SkyPrior(S),    d ~ CorrelatedNormal(A m, N)
                        d ~ TimesStudentT(A m, N, layout, nu)    the same with bad times
    d ~ Marginal(model)                                          the sky integrated out

with N of any structure.
"""

from abc import abstractmethod

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import gammaln
from jaxtyping import Float, PRNGKeyArray
from numpyro import distributions as dist

from lusee_bayes.core.arrays import Array, DataVector
from lusee_bayes.core.checks import require_positive
from lusee_bayes.core.errors import InputError
from lusee_bayes.instrument.products import DataLayout
from lusee_bayes.linear.linear_gaussian import LinearGaussian
from lusee_bayes.noise.covariance import Covariance, Factor
from lusee_bayes.sky.prior import Prior

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

    def __init__(self, prior: Prior):
        prior.require_density()
        self.prior = prior
        super().__init__(event_shape=(prior.size,))

    def sample(self, key: PRNGKeyArray, sample_shape: tuple[int, ...] = ()) -> Float[Array, "..."]:
        """Skies from the prior, ``(*sample_shape, unknowns)``, in K."""
        n = int(np.prod(sample_shape))
        return self.prior.sample(key, n).reshape(*sample_shape, self.prior.size)

    def log_prob(self, value: Float[Array, "..."]) -> Float[Array, "..."]:
        """Compute ln p(m) of one sky, or of every row of an array of skies."""
        u = self.prior.whiten(value)
        u = u - self.prior.white_mean.reshape(*(1,) * (value.ndim - 1), -1)
        return -0.5 * (u**2).sum(-1) - self.prior.log_det() - self.prior.size * HALF_LOG_2PI


class Prediction(dist.Distribution):
    """Data about a prediction, with the misfit and residual for a search for the mode."""

    support = dist.constraints.real_vector
    pytree_data_fields = ("factor", "loc")

    def __init__(self, loc: DataVector, noise: Covariance | Factor):
        self.loc = loc
        self.factor = noise.factor() if isinstance(noise, Covariance) else noise
        super().__init__(event_shape=loc.shape)

    @abstractmethod
    def misfit(self, value: Float[Array, "..."]) -> Float[Array, "..."]:
        """Compute the part of -ln p(d) that depends on d, for every row of an array."""

    @abstractmethod
    def residual(self, value: DataVector) -> DataVector:
        """Compute r such that J^T r, with J its Jacobian, is the gradient of the misfit.

        Both derivatives are with respect to the prediction; J^T J is the Gauss-Newton curvature.
        """

    def _white(self, value: Float[Array, "..."]) -> Float[Array, "data rows"]:
        """L^-1 (d - loc) for every row d of an array, N = L L^T."""
        residual = value - self.loc.reshape(*(1,) * (value.ndim - 1), -1)
        return self.factor.whiten(residual.reshape(-1, self.loc.shape[0]).T)


class CorrelatedNormal(Prediction):
    """d ~ N(loc, N) for any covariance of the package; event (data,).

    Parameters
    ----------
    loc : (data,) array
        Mean, in K.
    noise : Covariance or Factor
        N. If it is fixed, give ``noise.factor()``, so that it is factorised once and not at every
        evaluation of a model.
    """

    def sample(self, key: PRNGKeyArray, sample_shape: tuple[int, ...] = ()) -> Float[Array, "..."]:
        """Data vectors, ``(*sample_shape, data)``, in K."""
        n = int(np.prod(sample_shape))
        z = jax.random.normal(key, (self.loc.shape[0], n), dtype=jnp.float64)
        return (self.factor.colour(z).T + self.loc[None]).reshape(*sample_shape, -1)

    def log_prob(self, value: Float[Array, "..."]) -> Float[Array, "..."]:
        """Compute ln p(d | loc, N) of one data vector, or of every row of an array."""
        return -0.5 * self.factor.log_det() - self.loc.shape[0] * HALF_LOG_2PI - self.misfit(value)

    def misfit(self, value: Float[Array, "..."]) -> Float[Array, "..."]:
        """Compute chi^2 / 2 for every row of an array."""
        return 0.5 * (self._white(value) ** 2).sum(0).reshape(value.shape[:-1])

    def residual(self, value: DataVector) -> DataVector:
        """Compute L^-1 (d - loc), N = L L^T."""
        return self.factor.whiten(value - self.loc)


class TimesStudentT(Prediction):
    """The data of every time t a multivariate Student-t about loc_t; event (data,).

    ::

        d_t ~ N(loc_t, N_t / w_t),    w_t ~ Gamma(nu / 2, nu / 2),    with w_t integrated out.

    Times are independent of each other, and nu to infinity is CorrelatedNormal. N_t is the scale:
    the covariance of d_t is nu / (nu - 2) N_t.

    Parameters
    ----------
    loc : (data,) array
        Centre, in K.
    noise : Covariance or Factor
        N, which must not couple different times: diagonal, or a block for each time. If it is
        fixed, give ``noise.factor()``, as in CorrelatedNormal.
    layout : DataLayout
        The product and the time of every datum.
    nu : float or () array
        Degrees of freedom.

    Raises
    ------
    InputError
        If N couples different times, if the layout has another number of data, or if nu is not
        positive.

    References
    ----------
    Lange, Little & Taylor 1989, J. Am. Stat. Assoc. 84, 881.
    """

    pytree_data_fields = ("layout", "nu")

    def __init__(
        self, loc: DataVector, noise: Covariance | Factor, layout: DataLayout, nu: float | Array
    ):
        require_positive("nu of the Student-t", nu)
        if layout.size != loc.shape[0]:
            raise InputError(f"the layout has {layout.size} data, the mean {loc.shape[0]}")
        super().__init__(loc, noise)
        if self.factor.couples_times:
            raise InputError(
                "a Student-t for every time needs noise without correlation in time, not "
                f"{type(noise).__name__}; sample the terms that correlate times (gains, receivers, "
                "sources) instead of marginalising them, or remove them"
            )
        self.layout = layout
        self.nu = nu

    def sample(self, key: PRNGKeyArray, sample_shape: tuple[int, ...] = ()) -> Float[Array, "..."]:
        """Data vectors, ``(*sample_shape, data)``, in K."""
        n, layout = int(np.prod(sample_shape)), self.layout
        of_normal, of_weight = jax.random.split(key)
        z = jax.random.normal(of_normal, (layout.size, n), dtype=jnp.float64)
        gamma = jax.random.gamma(of_weight, self.nu / 2.0, (layout.n_times, n), dtype=jnp.float64)
        wider = jnp.sqrt(self.nu / 2.0 / gamma)
        draws = self.loc[:, None] + self.factor.colour(z) * wider[layout.time]
        return draws.T.reshape(*sample_shape, -1)

    def log_prob(self, value: Float[Array, "..."]) -> Float[Array, "..."]:
        """Compute ln p(d | loc, N, nu) of one data vector, or of every row of an array."""
        n = self._data_of_times()
        constant = (gammaln((self.nu + n) / 2.0) - n * jnp.log(self.nu) / 2.0).sum()
        constant = constant - self.layout.n_times * gammaln(self.nu / 2.0)
        constant = constant - self.layout.size * 0.5 * np.log(np.pi) - 0.5 * self.factor.log_det()
        return constant - self.misfit(value)

    def misfit(self, value: Float[Array, "..."]) -> Float[Array, "..."]:
        """Compute the sum of (nu + n_t) / 2 ln(1 + chi^2_t / nu) for every row of an array."""
        return jnp.log1p(self._chi2(value) / self.nu) @ (self.nu + self._data_of_times()) / 2.0

    def residual(self, value: DataVector) -> DataVector:
        """Compute sqrt(w_t) L^-1 (d - loc), N = L L^T, with fixed weights w_t."""
        held = jax.lax.stop_gradient(jnp.sqrt(self.weights(value)))
        return held[self.layout.time] * self.factor.whiten(value - self.loc)

    def weights(self, value: Float[Array, "..."]) -> Float[Array, "..."]:
        """Compute E[w_t | d, loc] = (nu + n_t) / (nu + chi^2_t) for n_t data, ``(..., times)``.

        Parameters
        ----------
        value : (..., data) array
            d, in K.
        """
        chi2, n = self._chi2(value), self._data_of_times()
        return (self.nu + n).reshape(*(1,) * (chi2.ndim - 1), -1) / (self.nu + chi2)

    def _data_of_times(self) -> Float[Array, " times"]:
        return jnp.asarray(self.layout.present.sum(0), dtype=jnp.float64)

    def _chi2(self, value: Float[Array, "..."]) -> Float[Array, "..."]:
        """Chi^2 of the data at every time, (..., times)."""
        white = self.layout.scatter(self._white(value))
        return (white**2).sum(0).T.reshape(*value.shape[:-1], self.layout.n_times)


class Marginal(dist.Distribution):
    """d with the sky integrated out: the evidence of a linear Gaussian model; event (data,).

    Parameters
    ----------
    model : LinearGaussian
        The model.
    """

    support = dist.constraints.real_vector
    pytree_data_fields = ("model",)

    def __init__(self, model: LinearGaussian):
        self.model = model
        super().__init__(event_shape=(model.n_data,))

    def sample(self, key: PRNGKeyArray, sample_shape: tuple[int, ...] = ()) -> Float[Array, "..."]:
        """Data vectors for skies from the prior, ``(*sample_shape, data)``, in K."""
        keys = jax.random.split(key, int(np.prod(sample_shape)))
        return jax.vmap(lambda k: self.model.sample(k)[1])(keys).reshape(*sample_shape, -1)

    def log_prob(self, value: Float[Array, "..."]) -> Float[Array, "..."]:
        """Compute ln p(d) of one data vector, or of every row of an array."""
        solver, flat = self.model.factorise(), value.reshape(-1, value.shape[-1])
        return jax.vmap(solver.log_prob)(flat).reshape(value.shape[:-1])
