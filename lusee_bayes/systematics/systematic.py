"""What is not known of instrument and sky: marginalised into N, or sampled.

Every systematic is a term of the noise covariance, and sites of a NumPyro program; a :class:`Chart`
has coordinates of several sites in which a posterior's ridges are straight.

Unknowns whose part in the data is linear, or taken to first order, are columns of N's square root:
N gets T T^T, a column of T for each unknown: what one prior standard deviation of it does to the
data. Where gains multiply what the data are of (:meth:`Templated.behind`), they multiply T, too.
Powers and temperatures add to the data in proportion: d = A m + T (x - mean) / std + n.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import replace
from statistics import NormalDist
from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, PRNGKeyArray

from lusee_bayes.core.arrays import Array, scalar
from lusee_bayes.core.checks import require_positive
from lusee_bayes.core.errors import InputError
from lusee_bayes.core.lazy import dist, numpyro
from lusee_bayes.instrument.products import DataLayout
from lusee_bayes.linear.linear_gaussian import LinearGaussian
from lusee_bayes.noise.covariance import Covariance, LowRankCovariance


class Chart(eqx.Module):
    """One-to-one coordinates of several sites in which a posterior's ridges are straight.

    Values are unconstrained (numpyro's ``biject_to``). Sites that are not among :attr:`names` are
    handed on as they are.

    Attributes
    ----------
    factorises : bool
        Whether it factorises matrices at every evaluation.
    """

    factorises: ClassVar[bool] = False

    @property
    @abstractmethod
    def names(self) -> tuple[str, ...]:
        """The sites whose coordinates it changes or needs."""

    @abstractmethod
    def to_values(
        self, x: Mapping[str, Float[Array, "..."]]
    ) -> tuple[dict[str, Float[Array, "..."]], Float[Array, ""]]:
        """Compute the sites' values.

        Parameters
        ----------
        x : mapping of array
            Coordinates by site.

        Returns
        -------
        values : dict of array
            Unconstrained values by site.
        log_det : () array
            ln|det| of their derivative by x.
        """

    @abstractmethod
    def from_values(
        self, values: Mapping[str, Float[Array, "..."]]
    ) -> dict[str, Float[Array, "..."]]:
        """Compute the coordinates of unconstrained values by site."""


# where programs sample the sky
SKY = "sky"
# with more unknowns than this beside an integrated sky, no exact Hessian says how to sample them:
# finding it takes two gradients of the evidence for each
MOST_COLLAPSED = 64


class Systematic(eqx.Module):
    """Something about the instrument or the sky that is not known.

    Both methods take a ``LinearGaussian`` and return one, so that systematics are applied one
    after the other.

    Attributes
    ----------
    needs_sky : bool
        Whether it has so many unknowns that the sky has to be sampled together with them.
    changes_coupling : bool
        Whether A depends on it: if not, A is made dense once and for all.
    """

    needs_sky: ClassVar[bool] = False
    changes_coupling: ClassVar[bool] = True

    def chart(self, model: LinearGaussian) -> Chart | None:
        """Return coordinates of its sites, and of the sky's, in which ridges are straight.

        Parameters
        ----------
        model : LinearGaussian
            What :meth:`sampled` is applied to.

        Returns
        -------
        Chart or None
            None if it needs no such coordinates.
        """
        return None

    def behind(self, response: Float[Array, " data"]) -> Systematic:
        """Return it as N holds it where gains multiply what the data are of.

        Parameters
        ----------
        response : (data,) array
            The gains.
        """
        return self

    @abstractmethod
    def marginalised(self, model: LinearGaussian) -> LinearGaussian:
        """Integrate it out of the model, as a term of N (and of the mean).

        Parameters
        ----------
        model : LinearGaussian
            The model without it.

        Returns
        -------
        LinearGaussian
            The model averaged over its prior.
        """

    @abstractmethod
    def sampled(self, model: LinearGaussian) -> LinearGaussian:
        """Sample it; call this inside a NumPyro program.

        Parameters
        ----------
        model : LinearGaussian
            The model without it.

        Returns
        -------
        LinearGaussian
            The model given the values of its sites.
        """


class AdditiveNoise(Systematic):
    """Gaussian noise with a covariance of its own, added to the data.

    A new kind is a subclass with one method, :meth:`covariance`.

    Attributes
    ----------
    name : str
        Its site is ``NAME_noise``.
    layout : DataLayout
        The data that the covariance is over.
    """

    changes_coupling: ClassVar[bool] = False

    name: str = eqx.field(static=True)
    layout: DataLayout

    @abstractmethod
    def covariance(self) -> Covariance:
        """Return its covariance over the entries of the data vector, in K^2."""

    @property
    def needs_sky(self) -> bool:
        return self.covariance().rank > MOST_COLLAPSED

    def marginalised(self, model: LinearGaussian) -> LinearGaussian:
        return replace(model, noise=model.noise + self.covariance())

    def sampled(self, model: LinearGaussian) -> LinearGaussian:
        """Sample the site ``NAME_noise``: (rank,) unit normals of which the noise is made."""
        covariance = self.covariance()
        normal = dist.Normal(jnp.zeros(covariance.rank), 1.0).to_event(1)
        noise = covariance.colour(numpyro.sample(f"{self.name}_noise", normal))
        return with_added(model, noise)

    def distort(
        self, visibilities: Float[Array, "products times"], key: PRNGKeyArray
    ) -> Float[Array, "products times"]:
        """Add one draw of the noise, as simulated data hold it.

        Parameters
        ----------
        visibilities : (products, times) array
            Visibilities on the full grid, in K.
        key : PRNG key
            For the draw.

        Returns
        -------
        (products, times) array
            In K; samples that the layout leaves out stay as they are.
        """
        return visibilities + self.layout.scatter(self.covariance().sample(key))


class Marginalised(Systematic):
    """A systematic that keeps its place among sampled ones, but is integrated out.

    Attributes
    ----------
    systematic : Systematic
        The systematic.
    """

    systematic: Systematic

    def marginalised(self, model: LinearGaussian) -> LinearGaussian:
        return self.systematic.marginalised(model)

    sampled = marginalised


class Scale(Systematic):
    """A systematic without a Gaussian term: marginalised, it stays at its median."""

    changes_coupling: ClassVar[bool] = False

    def marginalised(self, model: LinearGaussian) -> LinearGaussian:
        """Return the model as it is."""
        return model


def with_added(model: LinearGaussian, signal: Float[Array, " data"]) -> LinearGaussian:
    """Add a signal in K to the mean of a model's data."""
    return replace(model, offset=signal if model.offset is None else model.offset + signal)


def multiplied(model: LinearGaussian, response: Float[Array, " data"]) -> LinearGaussian:
    """Multiply the mean of a model's data, of sky and offset, by gains."""
    offset = None if model.offset is None else model.offset * response
    return replace(model, coupling=model.coupling.with_response(response), offset=offset)


def scalar_or_none(value: float | Float[Array, ""] | None) -> Float[Array, ""] | None:
    """Convert a number like :func:`scalar`; None stays None."""
    return None if value is None else scalar(value)


def uncertain_scale(
    value: float | Float[Array, ""], log_std: float | Float[Array, ""]
) -> dist.Distribution:
    """Return the prior of a positive number whose logarithm is Gaussian.

    Parameters
    ----------
    value : float
        The median.
    log_std : float
        Standard deviation of the natural logarithm.
    """
    return dist.LogNormal(jnp.log(scalar(value)), log_std)


def normal_within(
    name: str, mean: float, std: float, low: float = -np.inf, high: float = np.inf
) -> dist.Distribution:
    """Return N(mean, std), cut off at the ends of a parameter's domain.

    Parameters
    ----------
    name : str
        The parameter, for messages.
    mean, std : float
        Of the Gaussian, in the parameter's unit.
    low, high : float
        Ends of the domain.

    Raises
    ------
    InputError
        If 0.25 % or more of the Gaussian lies outside the domain: the prior then allows what
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


class Templated(Systematic):
    """Unknowns with independent Gaussian priors, and a column of N's square root for each.

    Subclasses have the attributes ``names``, ``stds`` (n,), ``templates`` (data, n) and
    ``response`` ((data,) or None).
    """

    @property
    def unit(self) -> str:
        """Unit of all values; empty for numbers, and where their names tell it."""
        return ""

    @property
    def labels(self) -> tuple[str, ...]:
        """The unknowns in words."""
        return self.names

    @property
    def columns(self) -> Float[Array, "data n"]:
        """The columns that are in N: the templates behind the gains, in K."""
        if self.response is None:
            return self.templates
        return self.templates * self.response[:, None]

    @property
    def expected(self) -> Float[Array, " n"]:
        """What :meth:`marginalised` takes the prior mean for, in prior standard deviations."""
        return np.zeros(len(self.names))

    def behind(self, response: Float[Array, " data"]) -> Systematic:
        return replace(self, response=response)

    def in_units(self, z: Float[np.ndarray, " n"]) -> dict[str, float]:
        """Values by name, of numbers in prior standard deviations from the prior mean."""
        return dict(zip(self.names, (np.asarray(self.stds) * z).tolist(), strict=True))

    def true(self, truth: Mapping[str, float | np.ndarray]) -> dict[str, float]:
        """True values by name, of those by site."""
        return {name: float(truth[name]) for name in self.names}


class Expanded(Templated):
    """Unknowns taken to first order about values.

    Subclasses have the attributes ``centre`` (n,), the values in prior standard deviations, and
    ``moves``: whether these are those that the data tell, found in rounds.
    """


class LinearUnknowns(Templated):
    """Temperatures with independent Gaussian priors, which add to the data in proportion.

    What they add on average is part of the model's offset already.

    Attributes
    ----------
    names : tuple of str
        Of the sites, each ending with ``_k``.
    means, stds : (unknowns,) array
        Of the priors, in K.
    templates : (data, unknowns) array
        T: what one prior standard deviation of each adds to the data, in K.
    response : (data,) array or None
        Gains that the templates are seen through in N; None for ones.
    """

    changes_coupling: ClassVar[bool] = False

    names: tuple[str, ...] = eqx.field(static=True)
    means: Float[Array, " unknowns"]
    stds: Float[Array, " unknowns"]
    templates: Float[Array, "data unknowns"]
    response: Float[Array, " data"] | None = None

    @property
    def unit(self) -> str:
        return "K"

    @property
    def labels(self) -> tuple[str, ...]:
        return tuple(name.removesuffix("_k").replace("_", " ") for name in self.names)

    def marginalised(self, model: LinearGaussian) -> LinearGaussian:
        """Add T T^T to N."""
        name = f"the {self.labels[0].split()[0]}"
        return replace(model, noise=model.noise + LowRankCovariance(self.columns, name))

    def sampled(self, model: LinearGaussian) -> LinearGaussian:
        """Sample one site for each, of its name, in K."""
        values = [
            numpyro.sample(name, dist.Normal(mean, std))
            for name, mean, std in zip(self.names, self.means, self.stds, strict=True)
        ]
        z = (jnp.stack([jnp.asarray(value) for value in values]) - self.means) / self.stds
        return with_added(model, self.templates @ z)

    def in_units(self, z: Float[np.ndarray, " n"]) -> dict[str, float]:
        values = np.asarray(self.means) + np.asarray(self.stds) * z
        return dict(zip(self.names, values.tolist(), strict=True))
