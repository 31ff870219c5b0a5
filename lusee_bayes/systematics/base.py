"""The two faces of a systematic: in the noise covariance, or a site of a NumPyro program."""

from __future__ import annotations

from abc import abstractmethod
from statistics import NormalDist

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpyro import distributions as dist

from lusee_bayes.checks import InputError, require_positive
from lusee_bayes.coordinates import Chart
from lusee_bayes.linear_gaussian import LinearGaussian


class Systematic(eqx.Module):
    """Something about the instrument or the sky that is not known.

    ``LinearGaussian`` in, ``LinearGaussian`` out: systematics are applied one after the other.
    """

    @property
    def needs_sky(self) -> bool:
        """Whether it has so many unknowns that the sky has to be sampled together with them."""
        return False

    @property
    def changes_coupling(self) -> bool:
        """Whether A depends on it: if not, A is made dense once and for all."""
        return True

    def chart(self, model: LinearGaussian) -> Chart | None:
        """Coordinates of its sites, and of the sky's, in which ridges are straight, if it has any.

        ``model``: what :meth:`sampled` is applied to.
        """
        return None

    @abstractmethod
    def marginalised(self, model: LinearGaussian) -> LinearGaussian:
        """The model with it integrated out, as a term of N (and of the mean)."""

    @abstractmethod
    def sampled(self, model: LinearGaussian) -> LinearGaussian:
        """The model given its values, which are NumPyro sites; call it inside a program."""


class Marginalised(Systematic):
    """A systematic whose place among sampled ones is kept, but which is integrated out."""

    systematic: Systematic

    def marginalised(self, model: LinearGaussian) -> LinearGaussian:
        return self.systematic.marginalised(model)

    def sampled(self, model: LinearGaussian) -> LinearGaussian:
        return self.systematic.marginalised(model)


def uncertain_scale(
    value: float | Float[Array, ""], log_std: float | Float[Array, ""]
) -> dist.Distribution:
    """A positive number of which ln is Gaussian about ln ``value``, its median."""
    return dist.LogNormal(jnp.log(jnp.asarray(value, dtype=jnp.float64)), log_std)


def normal_within(
    name: str, mean: float, std: float, low: float = -np.inf, high: float = np.inf
) -> dist.Distribution:
    """N(mean, std) cut off at the ends of a parameter's domain.

    InputError if a quarter of a percent of it or more would lie outside: the prior says then what
    cannot be.
    """
    require_positive(f"the prior standard deviation of {name}", std)
    cdf = NormalDist().cdf
    outside = cdf((low - mean) / std) + cdf((mean - high) / std)
    if outside > 0.0025:
        edge = f"at least {low:g}" if mean - low < high - mean else f"at most {high:g}"
        raise InputError(
            f"the prior of {name}, {mean:g} +- {std:g}, has {outside:.1%} of its weight outside "
            f"what it can be ({edge}); give a smaller standard deviation or move the mean"
        )
    if np.isinf(low) and np.isinf(high):
        return dist.Normal(mean, std)
    return dist.TruncatedNormal(
        mean, std, low=None if np.isinf(low) else low, high=None if np.isinf(high) else high
    )
