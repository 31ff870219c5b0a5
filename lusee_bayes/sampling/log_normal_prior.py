"""The prior of a positive sky, with fixed or sampled C_ell, for the program log_normal."""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Float

from lusee_bayes.core.arrays import Array
from lusee_bayes.core.lazy import dist, numpyro
from lusee_bayes.sky.positive_skies import LogNormalSky
from lusee_bayes.systematics.systematic import SKY

# the sites: white unknowns of the sky, and the parameters of C_ell of its logarithm
STRUCTURE, AMPLITUDE, TILT = "structure", "amplitude", "tilt"


class LogNormalPrior(eqx.Module):
    """A log-normal sky with C_ell = A^2 ((ell + 1) / 10)^tilt of its logarithm.

    ln A and the tilt are fixed, or have a Gaussian prior.

    Attributes
    ----------
    sky : LogNormalSky
        With the expected C_ell. If these are not fixed, those beyond ell = 0 are sampled.
    expected : (2,) array
        ln A and the tilt, or their prior means.
    std : (2,) array or None
        Prior standard deviations of both; None if they are fixed.
    """

    sky: LogNormalSky
    expected: Float[Array, "2"]
    std: Float[Array, "2"] | None = None

    @property
    def sites(self) -> tuple[str, ...]:
        """The sampled sites."""
        return (STRUCTURE,) if self.std is None else (AMPLITUDE, TILT, STRUCTURE)

    def sampled(self) -> Float[Array, " modes"]:
        """Sample the sky inside a NumPyro program.

        The sites are ``structure``, white unknowns; ``amplitude`` and ``tilt``, if C_ell is not
        fixed; and ``sky``, which is computed from these.

        Returns
        -------
        (modes,) array
            m, in K.
        """
        sky = self.sky
        if self.std is not None:
            amplitude, tilt = zip(self.expected, self.std, strict=True)
            amplitude = numpyro.sample(AMPLITUDE, dist.LogNormal(*amplitude))
            sky = sky.with_power_law(amplitude, numpyro.sample(TILT, dist.Normal(*tilt)))
        white = dist.Normal(jnp.zeros(sky.size), 1.0).to_event(1)
        return numpyro.deterministic(SKY, sky.modes(numpyro.sample(STRUCTURE, white)))
