"""Coordinates in which posteriors are round, for sampling: they change its speed, not its density.

handlers.reparam(config={"sky": Whitened(...)})     m sampled through z, m = mean + R z
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import numpyro
from jaxtyping import Array, Float
from numpyro import distributions as dist
from numpyro.infer.reparam import Reparam

from lusee_bayes.checks import InputError, is_traced
from lusee_bayes.posterior import Posterior
from lusee_bayes.sites import SkyPrior

# the site of z is that of m with this appended
WHITE_SUFFIX = "_white"


class Chart(eqx.Module):
    """Coordinates of several sites in which a posterior's ridges are straight, one to one.

    Values are unconstrained (numpyro's ``biject_to``); sites that are not among :attr:`names` are
    handed on as they are.
    """

    @property
    @abstractmethod
    def names(self) -> tuple[str, ...]:
        """The sites whose coordinates it changes or needs."""

    @property
    def factorises(self) -> bool:
        """Whether it factorises matrices at every evaluation."""
        return False

    @abstractmethod
    def to_values(
        self, x: Mapping[str, Float[Array, "..."]]
    ) -> tuple[dict[str, Float[Array, "..."]], Float[Array, ""]]:
        """Values of the sites at coordinates x, and ln|det| of their derivative by x."""

    @abstractmethod
    def from_values(
        self, values: Mapping[str, Float[Array, "..."]]
    ) -> dict[str, Float[Array, "..."]]:
        """The coordinates of values."""


class Whitening(eqx.Module):
    """Coordinates z of one or more sites, x = mean + R z, in which a posterior is round.

    x : the sites' values, unconstrained (numpyro's ``biject_to``), one site after the other; with a
    chart, its coordinates of them
    mean : (unknowns,); root : R (unknowns, white), R R^T the covariance; log_det : ln|det R|
    sites : name and unconstrained shape of each, in the order in which the program samples them
    """

    mean: Float[Array, " unknowns"]
    root: Float[Array, "unknowns white"]
    log_det: Float[Array, ""]
    sites: tuple[tuple[str, tuple[int, ...]], ...] = eqx.field(static=True)
    chart: Chart | None = None

    def __check_init__(self):
        n = sum(int(np.prod(shape)) for _, shape in self.sites)
        if not is_traced(self.mean) and self.mean.shape != (n,):
            raise InputError(f"the sites have {n} values, the mean {self.mean.shape[0]}")

    @classmethod
    def of(cls, posterior: Posterior, site: str = "sky") -> Whitening:
        """The coordinates in which ``posterior`` is N(0, 1). InputError as SkyPrior's."""
        log_det = jnp.log(SkyPrior(posterior.prior).scale).sum()
        log_det = log_det - jnp.log(jnp.diagonal(posterior.lower)).sum()
        root = posterior.root()
        return cls(posterior.mean, root, log_det, ((site, (root.shape[0],)),))

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the sites."""
        return tuple(name for name, _ in self.sites)

    def split(self, x: Float[Array, " unknowns"]) -> dict[str, Float[Array, "..."]]:
        """x by site, in its shape."""
        values, start = {}, 0
        for name, shape in self.sites:
            size = int(np.prod(shape))
            values[name] = x[start : start + size].reshape(shape)
            start += size
        return values

    def join(self, values: Mapping[str, Float[Array, "..."]]) -> Float[Array, " unknowns"]:
        """x of values by site."""
        return jnp.concatenate([values[name].reshape(-1) for name in self.names])

    def to_values(
        self, x: Float[Array, " unknowns"]
    ) -> tuple[dict[str, Float[Array, "..."]], Float[Array, ""]]:
        """Unconstrained values of the sites at x, and ln|det| of their derivative by x."""
        if self.chart is None:
            return self.split(x), jnp.zeros(())
        return self.chart.to_values(self.split(x))

    def from_values(self, values: Mapping[str, Float[Array, "..."]]) -> Float[Array, " unknowns"]:
        """x of unconstrained values of the sites."""
        return self.join(values if self.chart is None else self.chart.from_values(values))


class Whitened(Reparam):
    """Samples sites through z, x = mean + R z, by ``numpyro.handlers.reparam``.

    The density stays the model's own: its prior at x, times |det R|. Only the coordinates are those
    of some Gaussian; where it is not the posterior, sampling is slower and not wrong. z is the site
    NAME_white of the first site, improper, so that programs are drawn from (``Predictive``) without
    this handler. Several sites need one and the same object.
    """

    def __init__(self, whitening: Whitening):
        self.whitening = whitening
        self._values: dict[str, Float[Array, "..."]] = {}

    def __call__(self, name, fn, obs):
        if obs is not None:
            raise InputError(f"the site '{name}' is observed; only latent sites can be whitened")
        density = 0.0
        if name == self.whitening.names[0]:
            z = numpyro.sample(
                f"{name}{WHITE_SUFFIX}",
                dist.ImproperUniform(
                    dist.constraints.real_vector, (), (self.whitening.root.shape[1],)
                ),
            )
            x = self.whitening.mean + self.whitening.root @ z
            self._values, log_det = self.whitening.to_values(x)
            density = self.whitening.log_det + log_det
        free = self._values[name]
        transform = dist.biject_to(fn.support)
        value = transform(free)
        density = density + transform.log_abs_det_jacobian(free, value).sum()
        numpyro.factor(f"{name}_density", fn.log_prob(value).sum() + density)
        return None, value
