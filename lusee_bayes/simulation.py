"""What simulated data hold: the true instrument, its drifts and fluxes, and the data themselves."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpyro import handlers

from lusee_bayes.beams import Monopoles, ProductBeams, monopole_beams, placed
from lusee_bayes.building import build_background, build_beams, build_source_responses
from lusee_bayes.coupling import CouplingMatrix
from lusee_bayes.noise import GainDrift, rms_difference, with_gains
from lusee_bayes.scene import Scene
from lusee_bayes.systematics import InstrumentParameters, uncertain_scale
from lusee_bayes.visibilities import Visibilities

# what the scenario's seed is folded with for each kind of draw; the radiometer takes it as it is
GAIN_DRAW, BEAM_DRAW, LEVEL_DRAW, SOURCE_DRAW, SCALE_DRAW = 2, 3, 4, 5, 6


class Simulation(Scene):
    """A scene with its truth, drawn with the scenario's seed."""

    def truth(self) -> dict[str, float | np.ndarray]:
        """True values of what simulated data hold, by the names of their sites.

        Drawn with the scenario's seed from their priors.
        """
        key = jax.random.key(self.scenario.seed)
        truth: dict[str, float | np.ndarray] = {}
        radiometer, gain = self.scenario.noise.radiometer, self.scenario.noise.gain
        if radiometer.log_factor_std is not None:
            prior = uncertain_scale(1.0, radiometer.log_factor_std)
            truth["noise_level"] = float(prior.sample(jax.random.fold_in(key, LEVEL_DRAW)))
        beam = self.scenario.noise.beam
        if beam is not None and beam.parameters:
            priors = InstrumentParameters.about(self.instrument, beam.parameters).priors()
            keys = jax.random.split(jax.random.fold_in(key, BEAM_DRAW), len(priors))
            for (name, prior), k in zip(priors.items(), keys, strict=True):
                truth[name] = float(prior.sample(k))
        elif beam is not None:
            truth["beam_amplitude"] = 1.0
        if gain is not None:
            # the scales where they are not known; the prior is the program's own
            with handlers.seed(rng_seed=jax.random.fold_in(key, SCALE_DRAW)):
                drift = self.gain_drifts().scales()
            truth["gain_sigma"] = float(drift.sigma)
            truth["gain_correlation_h"] = float(drift.correlation_h)
        if self.responses:
            sources = self.sources().sources
            keys = jax.random.split(jax.random.fold_in(key, SOURCE_DRAW), len(sources))
            for source, k in zip(sources, keys, strict=True):
                z = np.asarray(jax.random.normal(k, (source.n_blocks,), dtype=np.float64))
                flux = source.mean + source.std * z
                truth[source.site] = float(flux[0]) if source.n_blocks == 1 else flux
        return truth

    def true_antennas(self) -> tuple[float, Monopoles]:
        """Frequency and antennas of the beams that simulated data are taken with."""
        beam, frequency = self.scenario.noise.beam, self.scenario.frequency_mhz
        antennas = self.instrument.monopoles
        if beam is None:
            return frequency, antennas
        if beam.shift_mhz is not None:
            return frequency + beam.shift_mhz, antennas
        truth = self.truth()
        return frequency, placed(antennas, {name: truth[name] for name in beam.parameters})

    def true_beams(self) -> ProductBeams:
        """The beams that simulated data are taken with."""
        beam = self.scenario.noise.beam
        if beam is None:
            return self.beams
        frequency, antennas = self.true_antennas()
        if beam.parameters:
            return monopole_beams(frequency, self.scenario.lmax, antennas)
        return build_beams(self.scenario, frequency, beam.file)

    def true_background(self) -> Float[Array, " products"] | None:
        """What simulated data hold without any sky, in K; None where nothing emits."""
        beam = self.scenario.noise.beam
        if beam is None or beam.parameters:
            return self.background
        return build_background(self.scenario, self.true_antennas()[0], beam.file)

    def beam_rms_difference(self) -> float | None:
        """RMS difference of the true beams and the model's, over the model's; None if the same."""
        if self.scenario.noise.beam is None:
            return None
        return rms_difference(self.true_beams(), self.beams)

    def simulate(self) -> Visibilities:
        """Visibilities of the scenario's sky with every draw from its seed."""
        key = jax.random.key(self.scenario.seed)
        truth = self.truth()
        visibilities = self.true_signal(truth)
        if "gain_sigma" in truth:
            drift = GainDrift(truth["gain_sigma"], truth["gain_correlation_h"])
            gains = drift.sample(jax.random.fold_in(key, GAIN_DRAW), self.observation.hours)
            visibilities = with_gains(visibilities, gains)
        layout = self.coupling.layout
        noise = self.radiometer().scaled(truth.get("noise_level", 1.0))
        return Visibilities(
            layout.gather(visibilities) + noise.sample(key),
            layout,
            self.observation,
            self.scenario.frequency_mhz,
            self.sky.modes,
        )

    def true_signal(self, truth: dict[str, float | np.ndarray]) -> Float[Array, "products times"]:
        """Visibilities of sky, ground and sources with the true antennas and fluxes, in K."""
        true = CouplingMatrix.build(self.true_beams(), self.pointing)
        visibilities = true.layout.scatter(true @ self.sky.modes)
        background = self.true_background()
        if background is not None:
            visibilities = visibilities + background[:, None]
        frequency, antennas = self.true_antennas()
        responses = build_source_responses(self.scenario, self.observation, antennas, frequency)
        for section, response in zip(self.scenario.sources.list, responses, strict=True):
            flux = np.atleast_1d(truth[f"flux_{section.name.replace(' ', '_')}"])
            visibilities = visibilities + jnp.asarray(flux)[self.blocks(section)][None] * response
        return visibilities
