"""The sky's prior power spectrum, up to a few unknown factors."""

from __future__ import annotations

from dataclasses import replace

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from lusee_bayes.core.arrays import Array
from lusee_bayes.core.errors import InputError
from lusee_bayes.core.lazy import dist, numpyro
from lusee_bayes.linear.model import LinearGaussian
from lusee_bayes.sky.priors import HarmonicPrior
from lusee_bayes.systematics.base import Scale, scalar, scalar_or_none, uncertain_scale

# the ell at which the amplitude of the spectrum is defined, plus one
PIVOT = 10.0


class PowerSpectrum(Scale):
    """The sky's prior spectrum up to an amplitude and a tilt: C_ell A ((ell + 1) / 10)^tilt.

    Marginalised, both stay at their medians, A = 1 and tilt = 0.

    Attributes
    ----------
    log_amplitude_std : () array, optional
        Prior standard deviation of ln A; None if A is known.
    tilt_std : () array, optional
        Prior standard deviation of the tilt; None if it is known.
    """

    log_amplitude_std: Float[Array, ""] | None = eqx.field(default=None, converter=scalar_or_none)
    tilt_std: Float[Array, ""] | None = eqx.field(default=None, converter=scalar_or_none)

    def sampled(self, model: LinearGaussian) -> LinearGaussian:
        """Sample the sites ``amplitude`` and ``tilt``, if they are not known.

        Raises
        ------
        InputError
            If the prior has no C_ell.
        """
        spectrum = _spectrum(model)
        if self.log_amplitude_std is not None:
            prior = uncertain_scale(1.0, self.log_amplitude_std)
            spectrum = spectrum * numpyro.sample("amplitude", prior)
        if self.tilt_std is not None:
            tilt = numpyro.sample("tilt", dist.Normal(jnp.zeros(()), self.tilt_std))
            ell = jnp.arange(float(spectrum.shape[0]))
            spectrum = spectrum * ((ell + 1.0) / PIVOT) ** tilt
        return replace(model, prior=HarmonicPrior(spectrum, mean=model.prior.mean))


class SpectrumBands(Scale):
    """The sky's prior spectrum up to a factor for each band of ells.

    Marginalised, all factors stay at one.

    Attributes
    ----------
    edges : tuple of int
        First ell of every band but the lowest, growing.
    log_std : () array
        Prior standard deviation of the natural logarithm of each factor.
    """

    edges: tuple[int, ...] = eqx.field(static=True)
    log_std: Float[Array, ""] = eqx.field(default=1.0, converter=scalar)

    def sampled(self, model: LinearGaussian) -> LinearGaussian:
        """Sample the site ``band_power`` (bands,): factors of C_ell, lowest ells first.

        Raises
        ------
        InputError
            If a band begins above the model's highest ell, or the prior has no C_ell.
        """
        spectrum = _spectrum(model)
        lmax = spectrum.shape[0] - 1
        if self.edges[-1] > lmax:
            raise InputError(f"a band begins at ell = {self.edges[-1]}, above lmax = {lmax}")
        band = np.searchsorted(np.asarray(self.edges), np.arange(lmax + 1), side="right")
        normal = dist.LogNormal(jnp.zeros(len(self.edges) + 1), self.log_std).to_event(1)
        power = numpyro.sample("band_power", normal)
        return replace(model, prior=HarmonicPrior(spectrum * power[band], mean=model.prior.mean))


def _spectrum(model: LinearGaussian) -> Float[Array, " ells"]:
    if not isinstance(model.prior, HarmonicPrior):
        raise InputError(
            f"a sampled spectrum is that of an isotropic prior, got {type(model.prior).__name__}; "
            "use a HarmonicPrior"
        )
    return model.prior.spectrum
