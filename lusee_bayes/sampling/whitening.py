"""Coordinates in which posteriors are round: they change the speed of sampling, not its density.

whitened(program, whitening)    samples m through z, m = mean + R z
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from lusee_bayes.core.arrays import Array
from lusee_bayes.core.checks import is_traced
from lusee_bayes.core.errors import InputError
from lusee_bayes.core.lazy import dist, numpyro
from lusee_bayes.linear.posterior import Posterior
from lusee_bayes.systematics.chart import Chart

# the site of z is that of m with this appended
WHITE_SUFFIX = "_white"


class Whitening(eqx.Module):
    """Coordinates z of one or more sites, x = mean + R z, in which a posterior is round.

    x are the sites' values, unconstrained (numpyro's ``biject_to``), one site after the other;
    with a chart, its coordinates of them.

    Attributes
    ----------
    mean : (unknowns,) array
        x at z = 0.
    root : (unknowns, white) array
        R, where R R^T is the covariance of x.
    log_det : () array
        ln|det R|.
    sites : tuple of (str, tuple of int)
        Name and unconstrained shape of each site.
    chart : Chart, optional
        Coordinates in which ridges are straight.

    Raises
    ------
    InputError
        If the sites have another number of values than the mean.
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
        """Return the coordinates in which a posterior of the sky is N(0, 1).

        Parameters
        ----------
        posterior : Posterior
            The analytic posterior.
        site : str
            Name of the sky's site.

        Raises
        ------
        InputError
            If the sky's prior has no density.
        """
        log_det = posterior.prior.log_det() - jnp.log(jnp.diagonal(posterior.lower)).sum()
        root = posterior.root()
        return cls(posterior.mean, root, log_det, ((site, (root.shape[0],)),))

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the sites."""
        return tuple(name for name, _ in self.sites)

    def split(self, x: Float[Array, " unknowns"]) -> dict[str, Float[Array, "..."]]:
        """Split x by site, each in its shape."""
        values, start = {}, 0
        for name, shape in self.sites:
            size = int(np.prod(shape))
            values[name] = x[start : start + size].reshape(shape)
            start += size
        return values

    def join(self, values: Mapping[str, Float[Array, "..."]]) -> Float[Array, " unknowns"]:
        """Join values by site to x."""
        return jnp.concatenate([values[name].reshape(-1) for name in self.names])

    def to_values(
        self, x: Float[Array, " unknowns"]
    ) -> tuple[dict[str, Float[Array, "..."]], Float[Array, ""]]:
        """Compute the sites' unconstrained values at x, and ln|det| of their derivative by x."""
        if self.chart is None:
            return self.split(x), jnp.zeros(())
        return self.chart.to_values(self.split(x))

    def from_values(self, values: Mapping[str, Float[Array, "..."]]) -> Float[Array, " unknowns"]:
        """Compute x of the sites' unconstrained values."""
        return self.join(values if self.chart is None else self.chart.from_values(values))


def whitened(program: Callable, whitening: Whitening) -> Callable:
    """Return a program that samples sites through z, x = mean + R z.

    The density stays the program's own: its prior at x, times ``|det R|``. Only the coordinates are
    those of some Gaussian; where it is not the posterior, sampling is slower and not wrong.

    Parameters
    ----------
    program : callable
        A NumPyro model.
    whitening : Whitening
        Coordinates of some of its latent sites.

    Returns
    -------
    callable
        The model with an improper site z, NAME_white of the first site. It cannot be drawn from
        without a value for z; draw from ``program`` itself.

    Raises
    ------
    InputError
        When it runs, if one of the sites is observed.
    """

    def model(*args, **kwargs):
        first = whitening.names[0]
        free = dist.ImproperUniform(dist.constraints.real_vector, (), (whitening.root.shape[1],))
        z = numpyro.sample(f"{first}{WHITE_SUFFIX}", free)
        values, log_det = whitening.to_values(whitening.mean + whitening.root @ z)
        # the determinant of all coordinates is counted once, with the first site
        log_dets = dict.fromkeys(whitening.names, 0.0) | {first: whitening.log_det + log_det}
        config = {name: _Given(values[name], log_dets[name]) for name in whitening.names}
        with numpyro.handlers.reparam(config=config):
            return program(*args, **kwargs)

    return model


@dataclass(frozen=True)
class _Given:
    """What makes a site with a given unconstrained value a deterministic one and its density.

    ``log_det``: of coordinates that the value was made of, added to the density.
    """

    value: Float[Array, "..."]
    log_det: float | Float[Array, ""]

    def __call__(self, name, fn, obs):
        if obs is not None:
            raise InputError(f"the site '{name}' is observed; only latent sites can be whitened")
        transform = dist.biject_to(fn.support)
        value = transform(self.value)
        density = self.log_det + transform.log_abs_det_jacobian(self.value, value).sum()
        numpyro.factor(f"{name}_density", fn.log_prob(value).sum() + density)
        return None, value
