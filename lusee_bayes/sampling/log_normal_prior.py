"""The prior of a positive sky, its C_ell known or not: what the program log_normal samples."""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Float

from lusee_bayes.core.arrays import Array
from lusee_bayes.core.checks import require_array, require_positive
from lusee_bayes.core.lazy import dist, numpyro
from lusee_bayes.sky.positive_skies import LogNormalSky
from lusee_bayes.systematics.systematic import SKY

# the sites: white unknowns of the sky, and what C_ell of its logarithm is made of
STRUCTURE, AMPLITUDE, TILT = "structure", "amplitude", "tilt"


class LogNormalPrior(eqx.Module):
    """A log-normal sky with C_ell = A^2 ((ell + 1) / 10)^tilt of its logarithm.

    ln A and the tilt are known, or Gaussian about these values.

    Attributes
    ----------
    sky : LogNormalSky
        With the expected C_ell, which are sampled beyond ell = 0 where they are not known.
    expected : (2,) array
        ln A and the tilt; their means, if they are not known.
    std : (2,) array or None
        Standard deviations of both; None if they are known.

    Raises
    ------
    InputError
        If ln A or the tilt is not finite, or a standard deviation not positive.
    """

    sky: LogNormalSky
    expected: Float[Array, "2"]
    std: Float[Array, "2"] | None = None

    def __check_init__(self):
        require_array("ln A and the tilt of the sky", self.expected, (2,))
        if self.std is not None:
            require_positive("the standard deviation of ln A or of the tilt", self.std)

    @property
    def samples_spectrum(self) -> bool:
        """Whether A and the tilt are unknowns."""
        return self.std is not None

    @property
    def sites(self) -> tuple[str, ...]:
        """The sites that are sampled."""
        return (AMPLITUDE, TILT, STRUCTURE) if self.samples_spectrum else (STRUCTURE,)

    def sampled(self) -> Float[Array, " modes"]:
        """Sample the sky inside a NumPyro program.

        The sites are ``structure``, white unknowns; where C_ell is not known, ``amplitude`` and
        ``tilt``; and, following from these, ``sky``.

        Returns
        -------
        (modes,) array
            m, in K.
        """
        sky = self.sky
        if self.samples_spectrum:
            amplitude, tilt = zip(self.expected, self.std, strict=True)
            amplitude = numpyro.sample(AMPLITUDE, dist.LogNormal(*amplitude))
            sky = sky.with_power_law(amplitude, numpyro.sample(TILT, dist.Normal(*tilt)))
        white = dist.Normal(jnp.zeros(sky.size), 1.0).to_event(1)
        return numpyro.deterministic(SKY, sky.modes(numpyro.sample(STRUCTURE, white)))
