"""How much noise there is: a factor of the radiometer's variance."""

from __future__ import annotations

from dataclasses import replace

import equinox as eqx
from jaxtyping import Float

from lusee_bayes.core.arrays import Array
from lusee_bayes.core.lazy import numpyro
from lusee_bayes.linear.model import LinearGaussian
from lusee_bayes.systematics.base import Scale, scalar, uncertain_scale


class NoiseLevel(Scale):
    """A factor of the variance of all noise that the model holds so far.

    There is no Gaussian term for it: marginalised, the level stays at one.

    Attributes
    ----------
    log_std : () array
        Prior standard deviation of the natural logarithm of the factor, whose median is one.
    """

    log_std: Float[Array, ""] = eqx.field(converter=scalar)

    def sampled(self, model: LinearGaussian) -> LinearGaussian:
        """Sample the site ``noise_level``, a ratio of variances."""
        level = numpyro.sample("noise_level", uncertain_scale(1.0, self.log_std))
        return replace(model, noise=model.noise.scaled(level))
