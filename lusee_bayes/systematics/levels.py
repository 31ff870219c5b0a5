"""How much noise and how much sky: the radiometer's level, and the prior's power spectrum."""

from __future__ import annotations

from dataclasses import replace

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import numpyro
from numpyro import distributions as dist

from lusee_bayes.checks import InputError
from lusee_bayes.linear_gaussian import LinearGaussian
from lusee_bayes.prior import HarmonicPrior
from lusee_bayes.systematics.base import Systematic, uncertain_scale

# the ell at which the amplitude of the spectrum is defined, plus one
PIVOT = 10.0


class _Level(Systematic):
    """Something that has no Gaussian term: marginalised, it stays at its median."""

    @property
    def changes_coupling(self) -> bool:
        return False

    def marginalised(self, model: LinearGaussian) -> LinearGaussian:
        """The model as it is."""
        return model


class NoiseLevel(_Level):
    """A factor of the variance of all noise that the model holds so far.

    log_std : prior standard deviation of ln of the factor, whose median is one. There is no
    Gaussian term for it: marginalised, the level stays at one.
    """

    log_std: float = eqx.field(static=True)

    def sampled(self, model: LinearGaussian) -> LinearGaussian:
        """The site ``noise_level``, a ratio of variances."""
        level = numpyro.sample("noise_level", uncertain_scale(1.0, self.log_std))
        return replace(model, noise=model.noise.scaled(level))


class PowerSpectrum(_Level):
    """The sky's prior spectrum up to an amplitude and a tilt: C_ell A ((ell + 1) / 10)^tilt.

    log_amplitude_std, tilt_std : prior standard deviations of ln A and of the tilt; None: known.
    Marginalised, both stay at their means.
    """

    log_amplitude_std: float | None = eqx.field(static=True, default=None)
    tilt_std: float | None = eqx.field(static=True, default=None)

    def sampled(self, model: LinearGaussian) -> LinearGaussian:
        """The sites ``amplitude`` and ``tilt``, those of them that are not known."""
        spectrum = model.prior.spectrum
        if self.log_amplitude_std is not None:
            prior = uncertain_scale(1.0, self.log_amplitude_std)
            spectrum = spectrum * numpyro.sample("amplitude", prior)
        if self.tilt_std is not None:
            tilt = numpyro.sample("tilt", dist.Normal(jnp.zeros(()), self.tilt_std))
            ell = jnp.arange(float(spectrum.shape[0]))
            spectrum = spectrum * ((ell + 1.0) / PIVOT) ** tilt
        return replace(model, prior=HarmonicPrior(spectrum))


class SpectrumBands(_Level):
    """The sky's prior spectrum up to a factor for each band of ells.

    edges : first ell of every band but the lowest, growing; log_std : prior standard deviation of
    ln of each factor. InputError for an edge above the highest ell. Marginalised, all stay at one.
    """

    edges: tuple[int, ...] = eqx.field(static=True)
    log_std: float = eqx.field(static=True, default=1.0)

    def sampled(self, model: LinearGaussian) -> LinearGaussian:
        """The site ``band_power`` (bands,): factors of C_ell, lowest ells first."""
        spectrum = model.prior.spectrum
        lmax = spectrum.shape[0] - 1
        if self.edges[-1] > lmax:
            raise InputError(f"a band begins at ell = {self.edges[-1]}, above lmax = {lmax}")
        band = np.searchsorted(np.asarray(self.edges), np.arange(lmax + 1), side="right")
        normal = dist.LogNormal(jnp.zeros(len(self.edges) + 1), self.log_std).to_event(1)
        power = numpyro.sample("band_power", normal)
        return replace(model, prior=HarmonicPrior(spectrum * power[band]))
