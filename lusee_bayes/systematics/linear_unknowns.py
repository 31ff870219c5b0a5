"""Powers and temperatures that add to the data in proportion: d = A m + T (x - mean) / std + n."""

from __future__ import annotations

from dataclasses import replace

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from lusee_bayes.core.arrays import Array
from lusee_bayes.core.lazy import dist, numpyro
from lusee_bayes.linear.model import LinearGaussian
from lusee_bayes.noise.covariance import LowRankCovariance
from lusee_bayes.systematics.base import with_added
from lusee_bayes.systematics.templated import Templated


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

    names: tuple[str, ...] = eqx.field(static=True)
    means: Float[Array, " unknowns"]
    stds: Float[Array, " unknowns"]
    templates: Float[Array, "data unknowns"]
    response: Float[Array, " data"] | None = None

    @property
    def changes_coupling(self) -> bool:
        return False

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
