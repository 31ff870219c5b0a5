"""Terms of N from receivers, ground, sources, prior, and the level of the noise.

Receivers, ground and sources are Gaussian amplitudes of templates. The prior's power spectrum and
the level of the radiometer noise can only be sampled.
"""

from __future__ import annotations

from typing import Any

import jax
import numpy as np
from jaxtyping import Float, PRNGKeyArray

from lusee_bayes.core.arrays import Grid
from lusee_bayes.core.errors import InputError
from lusee_bayes.experiment.instrument_terms import true_instrument
from lusee_bayes.experiment.scenario import Scenario
from lusee_bayes.experiment.setup import (
    Setup,
    block_of_times,
    ground_per_kelvin,
    mean_flux,
    receiver_powers,
    source_responses,
)
from lusee_bayes.experiment.term import Around, Term, Treated, Truth
from lusee_bayes.instrument.products import auto_indices
from lusee_bayes.systematics.instrument_unknowns import NoiseLevel
from lusee_bayes.systematics.sky_unknowns import PointSources, PowerSpectrum, Source, SpectrumBands
from lusee_bayes.systematics.systematic import LinearUnknowns, Systematic, uncertain_scale

# what the scenario's seed is folded with
RECEIVER_DRAW = 8
# cosines and sines of which a smooth spectrum is made
N_WAVES = 512


class ReceiverTerm(Term):
    """``noise.receiver``; simulated data hold a drawn power for each port.

    Its mean is part of the setup's background, and so of the radiometer noise.
    """

    key = "noise.receiver"

    def systematics(self, setup: Setup, section: Any, around: Around) -> list[Systematic]:
        means = receiver_powers(setup.scenario, setup.beam_source)
        stds = section.relative_std * means
        own = np.asarray(setup.layout.product)[:, None] == auto_indices(len(means))[None]
        return [LinearUnknowns(_names(len(means)), means, stds, own * stds[None])]

    def drawn(self, setup: Setup, section: Any, key: PRNGKeyArray) -> Truth:
        mean = receiver_powers(setup.scenario, setup.beam_source)
        if section.smooth_octaves is None:
            z = np.asarray(jax.random.normal(jax.random.fold_in(key, RECEIVER_DRAW), mean.shape))
        else:
            shared = key if section.smooth_seed is None else jax.random.key(section.smooth_seed)
            octave = float(np.log2(setup.scenario.frequency_mhz))
            own = jax.random.fold_in(shared, RECEIVER_DRAW)
            z = _smooth_spectra(own, len(mean), octave / section.smooth_octaves)
        powers = mean * (1.0 + section.relative_std * z)
        return dict(zip(_names(len(mean)), powers.tolist(), strict=True))

    def distorted(self, visibilities: Grid, setup: Setup, truth: Truth, key: PRNGKeyArray) -> Grid:
        n_ports = setup.beam_source.n_ports
        added = np.zeros((n_ports**2, 1))
        added[auto_indices(n_ports), 0] = [truth[name] for name in _names(n_ports)]
        return visibilities + added


def _smooth_spectra(key: PRNGKeyArray, n_ports: int, x: float) -> Float[np.ndarray, " ports"]:
    """Values at x of functions of covariance exp(-(x - x')^2 / 2), one for each port.

    ::

        z(x) = sum_k (a_k cos w_k x + b_k sin w_k x) / sqrt(K),    a, b, w ~ N(0, 1),

    whose covariance over keys is the mean of cos w (x - x'), and whose values are N(0, 1) for
    any w.
    """
    waves, cosines, sines = np.asarray(jax.random.normal(key, (3, n_ports, N_WAVES)))
    values = cosines * np.cos(waves * x) + sines * np.sin(waves * x)
    return values.sum(1) / np.sqrt(N_WAVES)


def is_receiver(name: str) -> bool:
    """Tell whether an unknown's name is that of a receiver's power."""
    return name.startswith("receiver_") and name.endswith("_k")


def _names(n_ports: int) -> tuple[str, ...]:
    return tuple(f"receiver_{port}_k" for port in range(n_ports))


# what the scenario's seed is folded with
GROUND_DRAW = 9
NAME = "regolith_k"


class RegolithTerm(Term):
    """``noise.regolith``; simulated data hold the emission of ground of a drawn temperature."""

    key = "noise.regolith"

    def systematics(self, setup: Setup, section: Any, around: Around) -> list[Systematic]:
        added = ground_per_kelvin(setup.beam_source, setup.scenario.frequency_mhz)
        template = added[np.asarray(setup.layout.product), None] * section.std_k
        mean = np.array([setup.scenario.beam.moon_temperature_k])
        return [LinearUnknowns((NAME,), mean, np.array([section.std_k]), template)]

    def drawn(self, setup: Setup, section: Any, key: PRNGKeyArray) -> Truth:
        z = float(jax.random.normal(jax.random.fold_in(key, GROUND_DRAW)))
        return {NAME: setup.scenario.beam.moon_temperature_k + section.std_k * z}

    def distorted(self, visibilities: Grid, setup: Setup, truth: Truth, key: PRNGKeyArray) -> Grid:
        true = true_instrument(setup)
        warmer = truth[NAME] - setup.scenario.beam.moon_temperature_k
        return visibilities + warmer * ground_per_kelvin(true.source, true.frequency_mhz)[:, None]


# what the scenario's seed is folded with
SOURCE_DRAW = 5


class SourcesTerm(Term):
    """``sources``; simulated data hold drawn fluxes, seen by the true antennas."""

    key = "sources"

    def section(self, scenario: Scenario) -> Any:
        return scenario.sources if scenario.sources.list else None

    def systematics(self, setup: Setup, section: Any, around: Around) -> list[Systematic]:
        return [point_sources(setup)]

    def drawn(self, setup: Setup, section: Any, key: PRNGKeyArray) -> Truth:
        sources = point_sources(setup).sources
        keys = jax.random.split(jax.random.fold_in(key, SOURCE_DRAW), len(sources))
        truth: Truth = {}
        for source, k in zip(sources, keys, strict=True):
            z = np.asarray(jax.random.normal(k, (source.n_blocks,), dtype=np.float64))
            flux = float(source.mean) + float(source.std) * z
            truth[source.site] = float(flux[0]) if source.n_blocks == 1 else flux
        return truth

    def distorted(self, visibilities: Grid, setup: Setup, truth: Truth, key: PRNGKeyArray) -> Grid:
        true = true_instrument(setup)
        responses = source_responses(
            setup.scenario, setup.observation, true.source, true.frequency_mhz
        )
        for section, response in zip(setup.scenario.sources.list, responses, strict=True):
            flux = np.atleast_1d(truth[f"flux_{section.name.replace(' ', '_')}"])
            block = block_of_times(section, setup.observation)
            visibilities = visibilities + np.asarray(flux)[block][None] * response
        return visibilities


def point_sources(setup: Setup) -> PointSources:
    """The point sources beside the map. InputError if the scenario has none."""
    if not setup.responses:
        raise InputError("the scenario has no sources.list that could be fitted")
    sources = []
    for section, response in zip(setup.scenario.sources.list, setup.responses, strict=True):
        flux = mean_flux(section, setup.scenario.frequency_mhz)
        block = block_of_times(section, setup.observation)
        of_blocks = [np.where((block == b)[None], response, 0.0) for b in range(block.max() + 1)]
        columns = np.stack([setup.layout.gather(seen) for seen in of_blocks], axis=1)
        sources.append(Source(columns, flux, section.relative_std * flux, section.name))
    return PointSources(tuple(sources))


class PriorSpectrumTerm(Term):
    """Amplitude and tilt of C_ell, or its bands; nothing of it is in the data."""

    key = "prior"

    def build(self, setup: Setup, around: Around) -> Treated:
        prior = setup.scenario.prior
        if not prior.samples:
            return []
        if prior.band_edges:
            return [("sampled", SpectrumBands(prior.band_edges, prior.log_band_std))]
        return [("sampled", PowerSpectrum(prior.log_amplitude_std, prior.tilt_std))]


# what the scenario's seed is folded with
LEVEL_DRAW = 4


class NoiseLevelTerm(Term):
    """``noise.radiometer.log_factor_std``; simulated data hold a drawn level."""

    key = "noise.radiometer"

    def build(self, setup: Setup, around: Around) -> Treated:
        std = setup.scenario.noise.radiometer.log_factor_std
        return [] if std is None else [("sampled", NoiseLevel(std))]

    def truth(self, setup: Setup, key: PRNGKeyArray) -> Truth:
        std = setup.scenario.noise.radiometer.log_factor_std
        if std is None:
            return {}
        drawn = uncertain_scale(1.0, std).sample(jax.random.fold_in(key, LEVEL_DRAW))
        return {"noise_level": float(drawn)}
