"""The sky's prior spectrum, known up to an amplitude and a tilt, or up to a factor per band.

There is no Gaussian term for them: if marginalised, they stay at their medians. Simulated data do
not depend on them.
"""

from dataclasses import replace
from typing import Annotated, Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import PRNGKeyArray
from pydantic import Field

from lusee_bayes.core.errors import InputError
from lusee_bayes.core.section import Positive, Section, requires
from lusee_bayes.sky.prior import PIVOT, HarmonicPrior
from lusee_bayes.systematics.context import Around, Setup
from lusee_bayes.systematics.systematic import Scale, Truth, Unknown


class SpectrumSection(Section):
    """Parameters of C_ell that can be sampled.

    Attributes
    ----------
    log_amplitude_std : float
        Prior standard deviation of ln A; if set, A is sampled.
    tilt_std : float
        Prior standard deviation of the tilt; if set, the tilt is sampled.
    band_edges : tuple of int
        First ell of each band except the lowest; if set, the band amplitudes are sampled.
    log_band_std : float
        Prior standard deviation of ln of each band amplitude.
    """

    log_amplitude_std: Positive | None = None
    tilt_std: Positive | None = None
    band_edges: tuple[Annotated[int, Field(ge=1)], ...] = ()
    log_band_std: Positive = 1.0

    _one_parameterisation = requires(
        lambda s: not (s.band_edges and (s.log_amplitude_std or s.tilt_std)),
        "give either band_edges or log_amplitude_std and tilt_std",
    )
    _bands_grow = requires(
        lambda section: list(section.band_edges) == sorted(set(section.band_edges)),
        "band_edges must increase",
    )

    @property
    def samples(self) -> bool:
        """Whether a parameter of the prior is to be sampled."""
        return bool(self.log_amplitude_std or self.tilt_std or self.band_edges)


class PriorSpectrum(Scale):
    """C_ell up to an amplitude and a tilt, A ((ell + 1) / 10)^tilt, or a factor for each band.

    Attributes
    ----------
    unknowns : tuple of Unknown
        The sites ``amplitude`` and ``tilt``, or ``band_power``: lowest ells first.
    edges : tuple of int
        First ell of every band except the lowest, increasing; empty for no bands.
    """

    key = "prior"
    # its true values are the sky's own
    moves_setup = True

    unknowns: tuple[Unknown, ...] = eqx.field()
    edges: tuple[int, ...] = eqx.field(static=True)

    @classmethod
    def treatment(cls, scenario: Any) -> str | None:
        return "sampled" if scenario.prior.samples else None

    @classmethod
    def build(cls, section: SpectrumSection, setup: Setup, around: Around) -> "PriorSpectrum":
        sites, n_bands = [], len(section.band_edges) + 1
        if section.log_amplitude_std is not None:
            sites.append(Unknown("amplitude", 1.0, section.log_amplitude_std, log=True))
        if section.tilt_std is not None:
            sites.append(Unknown("tilt", 0.0, section.tilt_std))
        if section.band_edges:
            sites.append(Unknown("band_power", 1.0, section.log_band_std, n_bands, log=True))
        return cls(tuple(sites), section.band_edges)

    @classmethod
    def truth(cls, section: Any, setup: Setup, key: PRNGKeyArray) -> Truth:
        return {}

    def effect(self, model, values):
        """Multiply C_ell by the factor of each ell.

        Raises
        ------
        InputError
            If the prior has no C_ell, or a band begins above its highest ell.
        """
        if not isinstance(model.prior, HarmonicPrior):
            wrong = f"a sampled spectrum needs a HarmonicPrior, got {type(model.prior).__name__}"
            raise InputError(wrong)
        spectrum = model.prior.spectrum
        ell = np.arange(spectrum.shape[0])
        if self.edges:
            if self.edges[-1] > ell[-1]:
                raise InputError(f"a band starts at ell = {self.edges[-1]}, above lmax = {ell[-1]}")
            band = np.searchsorted(np.asarray(self.edges), ell, side="right")
            spectrum = spectrum * values["band_power"][band]
        slope = jnp.asarray((ell + 1.0) / PIVOT) ** values.get("tilt", 0.0)
        spectrum = spectrum * values.get("amplitude", 1.0) * slope
        return replace(model, prior=HarmonicPrior(spectrum, mean=model.prior.mean))
