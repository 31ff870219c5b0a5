"""The prior of a positive sky, its C_ell known or not: what the program log_normal samples."""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from lusee_bayes.core.arrays import Array
from lusee_bayes.core.checks import require_positive
from lusee_bayes.core.lazy import dist, numpyro
from lusee_bayes.sky.log_normal import LogNormalSky
from lusee_bayes.systematics.systematic import SKY

# the sites: white unknowns of the sky, and what C_ell of its logarithm is made of
STRUCTURE, AMPLITUDE, TILT = "structure", "amplitude", "tilt"


class LogNormalPrior(eqx.Module):
    """A log-normal sky with C_ell = A^2 ((ell + 1) / 10)^tilt of its logarithm.

    ln A and the tilt are known, or Gaussian about these values.

    Attributes
    ----------
    sky : LogNormalSky
        With C_ell of ``amplitude`` and ``tilt``.
    amplitude, tilt : () array
        A and the tilt; their medians, if they are not known.
    log_amplitude_std, tilt_std : () array or None
        Standard deviations of ln A and of the tilt; None, both, if they are known.

    Raises
    ------
    InputError
        If A or a standard deviation is not positive.
    """

    sky: LogNormalSky
    amplitude: Float[Array, ""]
    tilt: Float[Array, ""]
    log_amplitude_std: Float[Array, ""] | None = None
    tilt_std: Float[Array, ""] | None = None

    @classmethod
    def of(
        cls,
        sky: LogNormalSky,
        amplitude: float,
        tilt: float,
        uncertain: tuple[float, float] | None = None,
    ) -> LogNormalPrior:
        """Make it.

        Parameters
        ----------
        sky : LogNormalSky
            Its C_ell beyond ell = 0 is replaced.
        amplitude, tilt : float
        uncertain : (float, float), optional
            Standard deviations of ln A and of the tilt, if they are not known.
        """
        stds = () if uncertain is None else tuple(np.asarray(float(std)) for std in uncertain)
        return cls(
            sky.with_power_law(amplitude, tilt),
            np.asarray(float(amplitude)),
            np.asarray(float(tilt)),
            *stds,
        )

    def __check_init__(self):
        require_positive("the amplitude of the logarithm of the sky", self.amplitude)
        if self.log_amplitude_std is not None:
            require_positive("the standard deviation of ln A", self.log_amplitude_std)
            require_positive("the standard deviation of the tilt", self.tilt_std)

    @property
    def samples_spectrum(self) -> bool:
        """Whether A and the tilt are unknowns."""
        return self.log_amplitude_std is not None

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
            median = jnp.log(self.amplitude)
            amplitude = numpyro.sample(AMPLITUDE, dist.LogNormal(median, self.log_amplitude_std))
            tilt = numpyro.sample(TILT, dist.Normal(self.tilt, self.tilt_std))
            sky = sky.with_power_law(amplitude, tilt)
        white = dist.Normal(jnp.zeros(sky.size), 1.0).to_event(1)
        return numpyro.deterministic(SKY, sky.modes(numpyro.sample(STRUCTURE, white)))
