"""Unknowns of the sky: point sources, and the prior's spectrum.

Sources of known place and unknown flux are columns of A with a prior of their own. The prior's
power spectrum may be known up to a few factors.
"""

from __future__ import annotations

from dataclasses import replace
from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from lusee_bayes.core.arrays import Array, scalar
from lusee_bayes.core.checks import require_finite, require_positive, require_shape
from lusee_bayes.core.errors import InputError
from lusee_bayes.core.lazy import dist, numpyro
from lusee_bayes.linear.linear_gaussian import LinearGaussian
from lusee_bayes.noise.covariance import LowRankCovariance
from lusee_bayes.sky.prior import HarmonicPrior
from lusee_bayes.systematics.systematic import (
    Scale,
    Systematic,
    scalar_or_none,
    uncertain_scale,
    with_added,
)


class Source(eqx.Module):
    """The response of the data to one source, and the prior of its flux.

    Attributes
    ----------
    columns : (data, blocks) array
        Response to 1 K sr in each block of time, in K per K sr.
    mean, std : () array
        Of the flux's Gaussian prior, in K sr.
    name : str
        The source's name.

    Raises
    ------
    InputError
        If the response is not finite or no matrix, or if ``std`` is not positive.
    """

    columns: Float[Array, "data blocks"]
    mean: Float[Array, ""] = eqx.field(converter=scalar)
    std: Float[Array, ""] = eqx.field(converter=scalar)
    name: str = eqx.field(static=True)

    def __check_init__(self):
        require_finite(f"the response to {self.name}", self.columns)
        require_shape(f"the response to {self.name}", self.columns, (None, None))
        require_positive(f"the prior standard deviation of {self.name}'s flux", self.std)

    @property
    def n_blocks(self) -> int:
        """Number of amplitudes."""
        return self.columns.shape[1]

    @property
    def site(self) -> str:
        """Name of its site: ``flux_Cas_A``."""
        return f"flux_{self.name.replace(' ', '_')}"

    def seen(self) -> np.ndarray:
        """Tell for each block whether the source is ever above the horizon: (blocks,) booleans.

        If not, only the prior says how bright it is.
        """
        return np.asarray(jnp.abs(self.columns).max(0) > 0)


class PointSources(Systematic):
    """Sources with independent Gaussian priors of their fluxes.

    The map is then the sky without them.

    Attributes
    ----------
    sources : tuple of Source
        The sources.
    response : (data,) array or None
        Gains that they are seen through in N; None for ones.
    """

    changes_coupling: ClassVar[bool] = False

    sources: tuple[Source, ...]
    response: Float[Array, " data"] | None = None

    def columns(self) -> Float[Array, "data amplitudes"]:
        """Return the responses of all sources and blocks side by side, in K per K sr."""
        return jnp.concatenate([source.columns for source in self.sources], axis=1)

    def mean(self) -> Float[Array, " amplitudes"]:
        """Return the prior means in K sr."""
        return jnp.concatenate([jnp.full(s.n_blocks, s.mean) for s in self.sources])

    def std(self) -> Float[Array, " amplitudes"]:
        """Return the prior standard deviations in K sr."""
        return jnp.concatenate([jnp.full(s.n_blocks, s.std) for s in self.sources])

    def templates(self) -> Float[Array, "data amplitudes"]:
        """What fluxes one prior standard deviation above their means add to the data, in K."""
        templates = self.columns() * self.std()[None]
        return templates if self.response is None else templates * self.response[:, None]

    def behind(self, response: Float[Array, " data"]) -> PointSources:
        return replace(self, response=response)

    def marginalised(self, model: LinearGaussian) -> LinearGaussian:
        """Add T P T^T to N, and the mean fluxes to the offset."""
        columns = self.columns()
        noise = model.noise + LowRankCovariance(self.templates(), "the sources")
        return with_added(replace(model, noise=noise), columns @ self.mean())

    def sampled(self, model: LinearGaussian) -> LinearGaussian:
        """Sample one site for each source: ``flux_NAME`` in K sr, (blocks,) or a number."""
        signal = jnp.zeros(model.n_data)
        for source in self.sources:
            prior = dist.Normal(jnp.full(source.n_blocks, source.mean), source.std)
            if source.n_blocks == 1:
                flux = numpyro.sample(source.site, dist.Normal(source.mean, source.std))
                signal = signal + source.columns[:, 0] * flux
            else:
                signal = signal + source.columns @ numpyro.sample(source.site, prior.to_event(1))
        return with_added(model, signal)


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
